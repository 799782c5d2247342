//! Heightmaps.

use super::error::{finite, positive, size, unexpected};
use super::{ConvertError, time_to_msg};
use crate::{geometry_msgs, sctn_msgs, std_msgs};
use ::heightmap::{Heightmap, Workspace};
use nalgebra::Point2;
use serde_bytes::ByteBuf;
use std::time::Duration;

/// A header.
pub fn header(stamp: Duration, frame_id: &str) -> Result<std_msgs::Header, ConvertError> {
    Ok(std_msgs::Header {
        stamp: time_to_msg(stamp)?,
        frame_id: frame_id.to_owned(),
    })
}

/// Takes the buffers over; checks sizes, ranges, and that all heights are finite.
pub fn heightmap_from_msg(msg: sctn_msgs::Heightmap) -> Result<Heightmap, ConvertError> {
    let at_least_one = |field, value: u32| match value {
        0 => Err(unexpected(field, 0, "at least 1")),
        _ => Ok(value as usize),
    };
    let (rows, cols) = (
        at_least_one("rows", msg.rows)?,
        at_least_one("cols", msg.cols)?,
    );
    let too_big = || {
        unexpected(
            "rows * cols",
            format!("{rows} * {cols}"),
            "a size that fits into memory",
        )
    };
    let cells = rows
        .checked_mul(cols)
        .filter(|cells| cells.checked_mul(4).is_some())
        .ok_or_else(too_big)?;
    size("rgb", msg.rgb.len(), 3 * cells)?;
    size("height_m", msg.height_m.len(), cells)?;
    let workspace = Workspace {
        origin_m: Point2::new(
            finite("origin.x", msg.origin.x)?,
            finite("origin.y", msg.origin.y)?,
        ),
        rows,
        cols,
        pixel_size_m: positive("pixel_size_m", msg.pixel_size_m)?,
        z_min_m: finite("z_min_m", msg.z_min_m)?,
        z_max_m: finite("z_max_m", msg.z_max_m)?,
    };
    if msg.origin.z != 0.0 {
        return Err(unexpected("origin.z", msg.origin.z, "0"));
    }
    if workspace.z_min_m >= workspace.z_max_m {
        return Err(unexpected(
            "z_max_m",
            workspace.z_max_m,
            format!("more than z_min_m = {}", workspace.z_min_m),
        ));
    }
    if let Some(index) = msg.height_m.iter().position(|height| !height.is_finite()) {
        return Err(ConvertError::ElementNotFinite {
            field: "height_m",
            index,
        });
    }
    if !(0.0..=1.0).contains(&msg.coverage) {
        return Err(unexpected(
            "coverage",
            msg.coverage,
            "a fraction between 0 and 1",
        ));
    }
    Ok(Heightmap {
        workspace,
        rgb: msg.rgb.into_vec(),
        height_m: msg.height_m,
    })
}

/// Takes the buffers over. `views` were fused and saw the fraction `coverage` of the cells.
pub fn heightmap_to_msg(
    heightmap: Heightmap,
    header: std_msgs::Header,
    views: usize,
    coverage: f64,
) -> Result<sctn_msgs::Heightmap, ConvertError> {
    let Heightmap {
        workspace,
        rgb,
        height_m,
    } = heightmap;
    let narrow = |field, value: usize| {
        u32::try_from(value).map_err(|_| unexpected(field, value, format!("at most {}", u32::MAX)))
    };
    size("rgb", rgb.len(), 3 * workspace.len())?;
    size("height_m", height_m.len(), workspace.len())?;
    Ok(sctn_msgs::Heightmap {
        header,
        rows: narrow("rows", workspace.rows)?,
        cols: narrow("cols", workspace.cols)?,
        pixel_size_m: workspace.pixel_size_m,
        origin: geometry_msgs::Point {
            x: workspace.origin_m.x,
            y: workspace.origin_m.y,
            z: 0.0,
        },
        z_min_m: workspace.z_min_m,
        z_max_m: workspace.z_max_m,
        rgb: ByteBuf::from(rgb),
        height_m,
        views: narrow("views", views)?,
        coverage: coverage as f32,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{from_cdr, to_cdr};
    use proptest::prelude::*;

    fn small() -> sctn_msgs::Heightmap {
        let workspace = Workspace {
            rows: 3,
            cols: 2,
            ..Workspace::RAVENS
        };
        heightmap_to_msg(
            Heightmap::new(workspace),
            header(Duration::ZERO, "world").unwrap(),
            3,
            1.0,
        )
        .unwrap()
    }

    fn refusal(spoil: impl FnOnce(&mut sctn_msgs::Heightmap)) -> String {
        let mut msg = small();
        spoil(&mut msg);
        heightmap_from_msg(msg).unwrap_err().to_string()
    }

    proptest! {
        #[test]
        fn heightmaps_pass_unchanged(rows in 1usize..9, cols in 1usize..9, seed: u64, origin: [i16; 2]) {
            let origin_m = Point2::new(f64::from(origin[0]) / 7.0, f64::from(origin[1]) / 3.0);
            let mut heightmap = Heightmap::new(Workspace { rows, cols, origin_m, ..Workspace::RAVENS });
            for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
                *byte = seed.rotate_left(index as u32) as u8;
            }
            for (index, height) in heightmap.height_m.iter_mut().enumerate() {
                *height = seed.rotate_left(index as u32) as u16 as f32 / 3.0;
            }
            let msg = heightmap_to_msg(heightmap.clone(), header(Duration::ZERO, "world").unwrap(), 3, 0.5).unwrap();
            let received = from_cdr(&to_cdr(&msg).unwrap()).unwrap();
            prop_assert_eq!(heightmap_from_msg(received).unwrap(), heightmap);
        }
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused() {
        assert_eq!(
            refusal(|msg| msg.rows = 4),
            "rgb has 18 elements, expected 24"
        );
        assert_eq!(
            refusal(|msg| msg.height_m.push(0.0)),
            "height_m has 7 elements, expected 6"
        );
        assert_eq!(
            refusal(|msg| msg.cols = 0),
            "cols is 0, expected at least 1"
        );
        refusal(|msg| (msg.rows, msg.cols) = (u32::MAX, u32::MAX));
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        assert_eq!(
            refusal(|msg| msg.height_m[4] = f32::NAN),
            "height_m[4] is not finite, expected a finite number"
        );
        assert_eq!(
            refusal(|msg| msg.pixel_size_m = 0.0),
            "pixel_size_m is 0, expected a positive number"
        );
        refusal(|msg| msg.origin.x = f64::INFINITY);
        refusal(|msg| msg.z_max_m = msg.z_min_m);
        refusal(|msg| msg.coverage = f32::NAN);
    }
}
