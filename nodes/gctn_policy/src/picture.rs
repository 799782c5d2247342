//! What a decision looks like: markers for RViz and Foxglove, and an image of both score maps.

use gctn::{Decision, ScoreMap};
use heightmap::Heightmap;
use msgs::{
    ByteBuf,
    geometry_msgs::{Point, Pose, Quaternion, Vector3},
    sensor_msgs::Image,
    std_msgs::{ColorRGBA, Header},
    visualization_msgs::{Marker, MarkerArray},
};
use nalgebra::{Isometry2, Point2};

const GREEN: [f32; 3] = [0.1, 0.8, 0.2];
const BLUE: [f32; 3] = [0.1, 0.4, 1.0];
const ARROW_LENGTH_M: f64 = 0.06;
const ARROW_WIDTH_M: f64 = 0.008;

/// Arrows from above at pick (green) and place (blue, its yaw as a second arrow), and a line between them.
pub fn markers(header: &Header, observation: &Heightmap, decision: &Decision) -> MarkerArray {
    let height_m = |pose: &Isometry2<f64>| {
        let point = Point2::from(pose.translation.vector);
        let pixel = observation.workspace.pixel(&point);
        pixel.map_or(0.0, |pixel| f64::from(observation.height_at_m(pixel)))
    };
    let point = |pose: &Isometry2<f64>, above_m: f64| Point {
        x: pose.translation.x,
        y: pose.translation.y,
        z: height_m(pose) + above_m,
    };
    let marker = |id, kind, color: [f32; 3]| Marker {
        header: header.clone(),
        ns: "pick_place".into(),
        id,
        r#type: kind,
        action: Marker::ADD,
        pose: Pose {
            orientation: Quaternion {
                w: 1.0,
                ..Quaternion::default()
            },
            ..Pose::default()
        },
        scale: Vector3 {
            x: ARROW_WIDTH_M,
            y: 2.0 * ARROW_WIDTH_M,
            z: 0.0,
        },
        color: ColorRGBA {
            r: color[0],
            g: color[1],
            b: color[2],
            a: 0.9,
        },
        ..Marker::default()
    };
    let down = |id, pose: &Isometry2<f64>, color| Marker {
        points: vec![point(pose, ARROW_LENGTH_M), point(pose, 0.0)],
        ..marker(id, Marker::ARROW, color)
    };
    let yaw_rad = decision.place.rotation.angle();
    let mut yaw = marker(2, Marker::ARROW, BLUE);
    yaw.pose.position = point(&decision.place, 0.0);
    yaw.pose.orientation = Quaternion {
        z: (yaw_rad / 2.0).sin(),
        w: (yaw_rad / 2.0).cos(),
        ..Quaternion::default()
    };
    yaw.scale = Vector3 {
        x: ARROW_LENGTH_M,
        y: ARROW_WIDTH_M,
        z: ARROW_WIDTH_M,
    };
    let line = Marker {
        points: vec![
            point(&decision.pick, ARROW_LENGTH_M),
            point(&decision.place, ARROW_LENGTH_M),
        ],
        ..marker(3, Marker::LINE_STRIP, GREEN)
    };
    MarkerArray {
        markers: vec![
            down(0, &decision.pick, GREEN),
            down(1, &decision.place, BLUE),
            yaw,
            line,
        ],
    }
}

/// Pick scores left, place scores right, over the dimmed colours; columns along x, rows along y. Scores
/// are shown by their square root, relative to the largest.
pub fn score_image(header: Header, observation: &Heightmap, decision: &Decision) -> Image {
    let (rows, cols) = (observation.workspace.rows, observation.workspace.cols);
    let mut data = Vec::with_capacity(rows * cols * 6);
    let panels = [(&decision.pick_map, GREEN), (&decision.place_map, BLUE)];
    let largest =
        panels.map(|(map, _)| map.scores.iter().copied().fold(f32::MIN_POSITIVE, f32::max));
    for row in 0..rows {
        for ((map, color), largest) in panels.iter().zip(largest) {
            for col in 0..cols {
                let weight = (score(map, row, col, rows, cols) / largest).max(0.0).sqrt();
                let cell = 3 * (row * cols + col);
                for (channel, tint) in color.iter().enumerate() {
                    let seen = f32::from(observation.rgb[cell + channel]) * 0.4;
                    let tinted = seen * (1.0 - weight) + 255.0 * tint * weight;
                    data.push(tinted.clamp(0.0, 255.0) as u8);
                }
            }
        }
    }
    Image {
        header,
        height: rows as u32,
        width: 2 * cols as u32,
        encoding: "rgb8".into(),
        is_bigendian: 0,
        step: 6 * cols as u32,
        data: ByteBuf::from(data),
    }
}

/// The score of the map's cell that covers a cell of the heightmap.
fn score(map: &ScoreMap, row: usize, col: usize, rows: usize, cols: usize) -> f32 {
    let index = (row * map.rows / rows) * map.cols + col * map.cols / cols;
    map.scores.get(index).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use gctn::Evidence;
    use std::f64::consts::FRAC_PI_2;

    use heightmap::Workspace;
    use nalgebra::Vector2;

    fn decision() -> Decision {
        let map = |best: usize| {
            let mut scores = vec![0.0; 50];
            scores[best] = 1.0;
            ScoreMap {
                rows: 10,
                cols: 5,
                scores,
            }
        };
        Decision {
            done: None,
            success: None,
            evidence: Evidence::default(),
            pick: Isometry2::new(Vector2::new(0.3, -0.4), 0.0),
            place: Isometry2::new(Vector2::new(0.7, 0.4), FRAC_PI_2),
            pick_score: 1.0,
            place_score: 1.0,
            pick_map: map(0),
            place_map: map(49),
        }
    }

    #[test]
    fn the_score_image_shows_pick_left_and_place_right_where_they_are() {
        let observation = Heightmap::new(Workspace::RAVENS);
        let image = score_image(Header::default(), &observation, &decision());
        assert_eq!((image.height, image.width, image.step), (320, 320, 960));
        assert_eq!(image.data.len(), 320 * 960);
        let pixel = |row: usize, col: usize| &image.data[row * 960 + 3 * col..][..3];
        assert!(pixel(0, 0)[1] > 150, "{:?}", pixel(0, 0));
        assert_eq!(pixel(319, 0), [0, 0, 0]);
        assert!(pixel(319, 319)[2] > 200, "{:?}", pixel(319, 319));
        assert_eq!(pixel(0, 319), [0, 0, 0]);
    }

    #[test]
    fn markers_stand_on_what_is_picked() {
        let mut observation = Heightmap::new(Workspace::RAVENS);
        observation.height_m.fill(0.05);
        let markers = markers(&Header::default(), &observation, &decision()).markers;
        let ids: Vec<i32> = markers.iter().map(|marker| marker.id).collect();
        assert_eq!(ids, [0, 1, 2, 3]);
        let tip = &markers[0].points[1];
        assert_eq!((tip.x, tip.y), (0.3, -0.4));
        assert!((tip.z - 0.05).abs() < 1e-6);
        let orientation = &markers[2].pose.orientation;
        assert!((orientation.z - (FRAC_PI_2 / 2.0).sin()).abs() < 1e-9);
    }
}
