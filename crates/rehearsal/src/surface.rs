//! Heights of the surfaces under a proposal, as they were seen.

use heightmap::Heightmap;
use nalgebra::Point2;
use pick_place::{ContactSettings, ContactSign, PickPlace, Touchdown};

/// The cup rests on what is this near (m).
const CUP_RADIUS_M: f64 = 0.008;
/// An object that is put down rests on what is this near, at least (m).
const FOOT_RADIUS_M: f64 = 0.015;
/// What lies beside an object is this near (m).
const BESIDE_M: f64 = 0.08;
/// Of the cells around a pose this share is lower than the top: single cells may be wrong.
const TOP: f64 = 0.9;
/// Of the cells beside an object this share is lower than its ground.
const GROUND: f64 = 0.05;

/// How the tip comes down for an action; `None` where the descents are to be fast to their end.
///
/// # Errors
/// Names the pose at which nothing was seen.
pub fn touchdown(
    heightmap: &Heightmap,
    action: &PickPlace,
    contact: &ContactSettings,
    sign: ContactSign,
) -> Result<Option<Touchdown>, String> {
    if contact.slow_from_m <= 0.0 {
        return match sign {
            ContactSign::UntilAction => Ok(None),
            // What is held is put down by height.
            ContactSign::Vacuum | ContactSign::Height => {
                Err("driver.contact vacuum and height need contact.slow_from_m above 0".to_owned())
            }
        };
    }
    let height_m = |which: &str, at: &Point2<f64>, radius_m, share| {
        quantile_m(heightmap, at, radius_m, share).ok_or_else(|| {
            format!("nothing was seen within {radius_m} m of the {which} pose, expected its height")
        })
    };
    let pick = Point2::from(action.pick.translation.vector);
    let place = Point2::from(action.place.translation.vector);
    Ok(Some(Touchdown {
        pick_m: height_m("pick", &pick, CUP_RADIUS_M, TOP)?,
        pick_ground_m: height_m("pick", &pick, BESIDE_M, GROUND)?,
        place_m: height_m("place", &place, FOOT_RADIUS_M, TOP)?,
        slow_from_m: contact.slow_from_m,
        slow_m_s: contact.slow_m_s,
        window_m: contact.window_m,
        press_m: contact.press_m,
        senses_pick: sign != ContactSign::Height,
        // What is held closes the cup: its vacuum does not tell of contact.
        senses_place: sign == ContactSign::UntilAction,
    }))
}

/// The height of what the cup meets at a point (m); `None` where none was seen.
pub(crate) fn top_m(heightmap: &Heightmap, at: &Point2<f64>) -> Option<f64> {
    quantile_m(heightmap, at, CUP_RADIUS_M, TOP)
}

/// The height that a share of the cells around a point do not exceed (m); `None` where none was seen.
fn quantile_m(
    heightmap: &Heightmap,
    center: &Point2<f64>,
    radius_m: f64,
    share: f64,
) -> Option<f64> {
    let workspace = &heightmap.workspace;
    let center_px = workspace.point_px(center);
    let radius_px = (radius_m / workspace.pixel_size_m).max(1.0);
    let range = |middle: f64, count: usize| {
        let low = (middle - radius_px).floor().max(0.0) as usize;
        let high = (middle + radius_px).ceil().max(0.0) as usize;
        low..high.min(count)
    };
    let mut heights_m = Vec::new();
    for row in range(center_px.y, workspace.rows) {
        for col in range(center_px.x, workspace.cols) {
            let middle = Point2::new(col as f64 + 0.5, row as f64 + 0.5);
            let index = row * workspace.cols + col;
            if (middle - center_px).norm() <= radius_px && heightmap.is_seen(index) {
                heights_m.push(heightmap.height_m[index]);
            }
        }
    }
    heights_m.sort_by(f32::total_cmp);
    let last = heights_m.len().checked_sub(1)?;
    Some(heights_m[(share * last as f64).round() as usize].into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use heightmap::{Pixel, Workspace};
    use nalgebra::{Isometry2, Vector2};

    /// A grey table at height 0 with a block of 40 mm around (0.5, 0.2).
    fn table() -> Heightmap {
        let mut heightmap = Heightmap::new(Workspace::RAVENS);
        heightmap.rgb.fill(90);
        let workspace = heightmap.workspace;
        for row in 0..workspace.rows {
            for col in 0..workspace.cols {
                let center = workspace.center(Pixel { row, col });
                let near = (center.coords - Vector2::new(0.5, 0.2)).amax() < 0.02;
                heightmap.height_m[row * workspace.cols + col] = if near { 0.04 } else { 0.0 };
            }
        }
        heightmap
    }

    fn action() -> PickPlace {
        PickPlace {
            pick: Isometry2::new(Vector2::new(0.5, 0.2), 0.0),
            place: Isometry2::new(Vector2::new(0.5, -0.2), 0.0),
        }
    }

    fn slow() -> ContactSettings {
        ContactSettings {
            slow_from_m: 0.03,
            ..ContactSettings::default()
        }
    }

    #[test]
    fn the_heights_of_object_ground_and_place_are_read_and_single_cells_do_not_count() {
        let mut heightmap = table();
        let at = heightmap.workspace.pixel(&Point2::new(0.5, 0.2)).unwrap();
        heightmap.height_m[at.row * heightmap.workspace.cols + at.col] = 0.2;
        let found = touchdown(&heightmap, &action(), &slow(), ContactSign::Vacuum);
        let found = found.unwrap().unwrap();
        let heights_m = [found.pick_m, found.pick_ground_m, found.place_m];
        let expected_m = [0.04, 0.0, 0.0];
        for (found_m, expected_m) in heights_m.into_iter().zip(expected_m) {
            assert!((found_m - expected_m).abs() < 1e-6, "{heights_m:?}");
        }
        assert!(found.senses_pick && !found.senses_place);
    }

    #[test]
    fn a_pose_at_which_nothing_was_seen_is_refused_by_name() {
        let mut heightmap = table();
        let place = heightmap.workspace.point_px(&Point2::new(0.5, -0.2));
        for row in 0..heightmap.workspace.rows {
            for col in 0..heightmap.workspace.cols {
                let middle = Point2::new(col as f64, row as f64);
                if (middle - place).norm() < 20.0 {
                    let index = row * heightmap.workspace.cols + col;
                    heightmap.rgb[3 * index..3 * index + 3].fill(0);
                }
            }
        }
        let reason = touchdown(&heightmap, &action(), &slow(), ContactSign::UntilAction);
        let reason = reason.unwrap_err();
        assert!(reason.contains("the place pose"), "{reason}");
    }

    #[test]
    fn without_a_slow_part_the_surfaces_do_not_count_and_contact_has_to_be_sensed() {
        let fast = ContactSettings {
            slow_from_m: 0.0,
            ..ContactSettings::default()
        };
        let of = |sign| touchdown(&table(), &action(), &fast, sign);
        assert_eq!(of(ContactSign::UntilAction), Ok(None));
        for sign in [ContactSign::Vacuum, ContactSign::Height] {
            assert!(of(sign).unwrap_err().contains("slow_from_m"));
        }
    }
}
