//! Images and calibrations of cameras.

use super::ConvertError;
use super::error::{all_finite, positive, size, unexpected};
use crate::{sensor_msgs, std_msgs};
use ::heightmap::{Distortion, Intrinsics};
use serde_bytes::ByteBuf;

/// Rows of an image without their padding, once the sizes are right.
fn rows(
    image: &sensor_msgs::Image,
    (width, height): (usize, usize),
    pixel_bytes: usize,
) -> Result<impl Iterator<Item = &[u8]>, ConvertError> {
    let same = |field, actual: u32, expected: usize| {
        if actual as usize == expected {
            Ok(())
        } else {
            Err(unexpected(field, actual, format!("{expected}")))
        }
    };
    same("width", image.width, width)?;
    same("height", image.height, height)?;
    let row_bytes = width * pixel_bytes;
    let step = image.step as usize;
    if step < row_bytes || row_bytes == 0 {
        return Err(unexpected(
            "step",
            step,
            format!("at least {row_bytes} for {width} pixels"),
        ));
    }
    let bytes = step
        .checked_mul(height)
        .ok_or_else(|| unexpected("step", step, "a sane size"))?;
    size("data", image.data.len(), bytes)?;
    Ok(image
        .data
        .chunks_exact(step)
        .map(move |row| &row[..row_bytes]))
}

/// Colour of an image of encoding rgb8, bgr8, rgba8, bgra8 or mono8 (grey) as red, green, blue, row-major, without
/// padding. Its size must be that of `expected`. `rgb` is overwritten.
pub fn color_from_msg(
    image: &sensor_msgs::Image,
    expected: &Intrinsics,
    rgb: &mut Vec<u8>,
) -> Result<(), ConvertError> {
    rgb.clear();
    let size_px = (expected.width, expected.height);
    match image.encoding.as_str() {
        "rgb8" => rows(image, size_px, 3)?.for_each(|row| rgb.extend_from_slice(row)),
        "bgr8" => rows(image, size_px, 3)?.for_each(|row| {
            rgb.extend(
                row.as_chunks::<3>()
                    .0
                    .iter()
                    .flat_map(|&[b, g, r]| [r, g, b]),
            )
        }),
        "rgba8" => rows(image, size_px, 4)?.for_each(|row| {
            rgb.extend(
                row.as_chunks::<4>()
                    .0
                    .iter()
                    .flat_map(|&[r, g, b, _]| [r, g, b]),
            )
        }),
        "bgra8" => rows(image, size_px, 4)?.for_each(|row| {
            rgb.extend(
                row.as_chunks::<4>()
                    .0
                    .iter()
                    .flat_map(|&[b, g, r, _]| [r, g, b]),
            )
        }),
        "mono8" => rows(image, size_px, 1)?
            .for_each(|row| rgb.extend(row.iter().flat_map(|&grey| [grey; 3]))),
        other => {
            return Err(unexpected(
                "encoding",
                format!("{other:?}"),
                "rgb8, bgr8, rgba8, bgra8 or mono8",
            ));
        }
    }
    Ok(())
}

/// Depth in metres of an image of encoding 16UC1 or mono16 (millimetres) or 32FC1 (metres), row-major, without padding, of
/// the image's own size, which is `width` times `height` of the message. 0 and values that are not finite stand for "nothing measured" (REP-118), and
/// so do negative ones: one odd pixel is no reason to lose a view. `depth_m` is overwritten.
pub fn depth_from_msg(
    image: &sensor_msgs::Image,
    depth_m: &mut Vec<f32>,
) -> Result<(), ConvertError> {
    depth_m.clear();
    let own = (image.width as usize, image.height as usize);
    let big_endian = match image.is_bigendian {
        0 => false,
        1 => true,
        other => return Err(unexpected("is_bigendian", other, "0 or 1")),
    };
    match image.encoding.as_str() {
        // Older drivers say mono16, in millimetres too.
        "16UC1" | "mono16" => {
            let meters = |bytes: [u8; 2], read: fn([u8; 2]) -> u16| f32::from(read(bytes)) / 1000.0;
            let read = if big_endian {
                u16::from_be_bytes
            } else {
                u16::from_le_bytes
            };
            rows(image, own, 2)?.for_each(|row| {
                depth_m.extend(
                    row.as_chunks::<2>()
                        .0
                        .iter()
                        .map(|&bytes| meters(bytes, read)),
                )
            });
        }
        "32FC1" => {
            let read = if big_endian {
                f32::from_be_bytes
            } else {
                f32::from_le_bytes
            };
            rows(image, own, 4)?.for_each(|row| {
                depth_m.extend(row.as_chunks::<4>().0.iter().map(|&bytes| read(bytes)))
            });
        }
        other => {
            return Err(unexpected(
                "encoding",
                format!("{other:?}"),
                "16UC1, mono16 or 32FC1",
            ));
        }
    }
    Ok(())
}

fn image(
    header: std_msgs::Header,
    camera: &Intrinsics,
    encoding: &str,
    pixel_bytes: usize,
    data: Vec<u8>,
) -> Result<sensor_msgs::Image, ConvertError> {
    size(
        "data",
        data.len(),
        camera.width * camera.height * pixel_bytes,
    )?;
    Ok(sensor_msgs::Image {
        header,
        height: camera.height as u32,
        width: camera.width as u32,
        encoding: encoding.to_owned(),
        is_bigendian: 0,
        step: (camera.width * pixel_bytes) as u32,
        data: ByteBuf::from(data),
    })
}

/// Red, green and blue of each pixel, row-major, as an image of encoding rgb8. Takes the buffer over.
pub fn color_to_msg(
    header: std_msgs::Header,
    camera: &Intrinsics,
    rgb: Vec<u8>,
) -> Result<sensor_msgs::Image, ConvertError> {
    image(header, camera, "rgb8", 3, rgb)
}

/// Depth in metres as an image of encoding 32FC1.
pub fn depth_to_msg(
    header: std_msgs::Header,
    camera: &Intrinsics,
    depth_m: &[f32],
) -> Result<sensor_msgs::Image, ConvertError> {
    image(
        header,
        camera,
        "32FC1",
        4,
        depth_m
            .iter()
            .flat_map(|depth| depth.to_le_bytes())
            .collect(),
    )
}

/// Depth in metres as an image of encoding 16UC1, rounded to millimetres; 0 for what is not finite or too far.
pub fn depth_to_msg_mm(
    header: std_msgs::Header,
    camera: &Intrinsics,
    depth_m: &[f32],
) -> Result<sensor_msgs::Image, ConvertError> {
    let millimeters = |depth: &f32| {
        let millimeters = (depth * 1000.0).round();
        if (0.0..=f32::from(u16::MAX)).contains(&millimeters) {
            millimeters as u16
        } else {
            0
        }
    };
    image(
        header,
        camera,
        "16UC1",
        2,
        depth_m
            .iter()
            .flat_map(|depth| millimeters(depth).to_le_bytes())
            .collect(),
    )
}

/// Lens of a calibration.
fn distortion_from_msg(info: &sensor_msgs::CameraInfo) -> Result<Distortion, ConvertError> {
    all_finite("d", &info.d)?;
    Distortion::from_model(&info.distortion_model, &info.d)
        .map_err(|error| unexpected(error.field, error.actual, error.expected))
}

/// Intrinsics of a full-size image: no binning, no region of interest.
pub fn intrinsics_from_msg(info: &sensor_msgs::CameraInfo) -> Result<Intrinsics, ConvertError> {
    let at_least_one = |field, value: u32| match value {
        0 => Err(unexpected(field, 0, "at least 1")),
        _ => Ok(value as usize),
    };
    all_finite("k", &info.k)?;
    let [fx, skew, cx, zero_10, fy, cy, zero_20, zero_21, one] = info.k;
    if [skew, zero_10, zero_20, zero_21, one] != [0.0, 0.0, 0.0, 0.0, 1.0] {
        return Err(unexpected(
            "k",
            format!("{:?}", info.k),
            "[fx, 0, cx, 0, fy, cy, 0, 0, 1]",
        ));
    }
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    if info.r != identity && info.r != [0.0; 9] {
        return Err(unexpected("r", format!("{:?}", info.r), "the identity"));
    }
    for (field, binning) in [("binning_x", info.binning_x), ("binning_y", info.binning_y)] {
        if binning > 1 {
            return Err(unexpected(field, binning, "0 or 1"));
        }
    }
    let roi = &info.roi;
    let full = [0, 0, info.width, info.height];
    let actual = [roi.x_offset, roi.y_offset, roi.width, roi.height];
    if actual != [0; 4] && actual != full {
        return Err(unexpected(
            "roi",
            format!("{actual:?}"),
            format!("the whole image: zeros or {full:?}"),
        ));
    }
    Ok(Intrinsics {
        width: at_least_one("width", info.width)?,
        height: at_least_one("height", info.height)?,
        fx_px: positive("k[0]", fx)?,
        fy_px: positive("k[4]", fy)?,
        cx_px: cx,
        cy_px: cy,
        distortion: distortion_from_msg(info)?,
    })
}

/// Calibration of a camera.
pub fn intrinsics_to_msg(header: std_msgs::Header, camera: &Intrinsics) -> sensor_msgs::CameraInfo {
    let Intrinsics {
        width,
        height,
        fx_px: fx,
        fy_px: fy,
        cx_px: cx,
        cy_px: cy,
        distortion,
    } = *camera;
    sensor_msgs::CameraInfo {
        header,
        height: height as u32,
        width: width as u32,
        distortion_model: distortion.model().to_owned(),
        d: distortion.coefficients(),
        k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        ..Default::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics = Intrinsics {
        width: 2,
        height: 2,
        fx_px: 450.0,
        fy_px: 440.0,
        cx_px: 1.0,
        cy_px: 0.5,
        distortion: Distortion::NONE,
    };

    fn padded(encoding: &str, is_bigendian: u8, step: u32, data: &[u8]) -> sensor_msgs::Image {
        sensor_msgs::Image {
            width: 2,
            height: 2,
            encoding: encoding.into(),
            is_bigendian,
            step,
            data: ByteBuf::from(data.to_vec()),
            ..Default::default()
        }
    }

    #[test]
    fn grey_images_have_their_grey_in_every_color() {
        let mut rgb = Vec::new();
        color_from_msg(
            &padded("mono8", 0, 3, &[1, 2, 0, 3, 4, 0]),
            &CAMERA,
            &mut rgb,
        )
        .unwrap();
        assert_eq!(rgb, [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]);
    }

    #[test]
    fn four_color_encodings_give_the_same_pixels() {
        let expected = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12];
        let images = [
            padded("rgb8", 0, 6, &expected),
            padded(
                "bgr8",
                0,
                8,
                &[3, 2, 1, 6, 5, 4, 0, 0, 9, 8, 7, 12, 11, 10, 0, 0],
            ),
            padded(
                "rgba8",
                0,
                8,
                &[1, 2, 3, 255, 4, 5, 6, 255, 7, 8, 9, 255, 10, 11, 12, 255],
            ),
            padded(
                "bgra8",
                0,
                8,
                &[3, 2, 1, 255, 6, 5, 4, 255, 9, 8, 7, 255, 12, 11, 10, 255],
            ),
        ];
        let mut rgb = vec![99];
        for image in images {
            color_from_msg(&image, &CAMERA, &mut rgb).unwrap();
            assert_eq!(rgb, expected, "{}", image.encoding);
        }
    }

    #[test]
    fn depth_of_either_byte_order_is_in_metres() {
        let mut depth_m = vec![99.0];
        let little = padded("16UC1", 0, 5, &[232, 3, 0, 0, 9, 1, 0, 255, 255, 9]);
        depth_from_msg(&little, &mut depth_m).unwrap();
        assert_eq!(depth_m, [1.0, 0.0, 0.001, 65.535]);
        let big = padded("16UC1", 1, 4, &[3, 232, 0, 0, 0, 1, 255, 255]);
        depth_from_msg(&big, &mut depth_m).unwrap();
        assert_eq!(depth_m, [1.0, 0.0, 0.001, 65.535]);
        let values: [f32; 4] = [0.5, f32::NAN, f32::INFINITY, 0.0];
        let bytes: Vec<u8> = values
            .iter()
            .flat_map(|value| value.to_be_bytes())
            .collect();
        depth_from_msg(&padded("32FC1", 1, 8, &bytes), &mut depth_m).unwrap();
        assert_eq!(
            depth_m
                .iter()
                .map(|depth| depth.to_bits())
                .collect::<Vec<_>>(),
            values.map(f32::to_bits)
        );
    }

    #[test]
    fn mono16_depth_is_in_millimetres_like_16uc1() {
        let mut depth_m = Vec::new();
        let image = padded("mono16", 0, 4, &[232, 3, 0, 0, 1, 0, 255, 255]);
        depth_from_msg(&image, &mut depth_m).unwrap();
        assert_eq!(depth_m, [1.0, 0.0, 0.001, 65.535]);
    }

    #[test]
    fn a_lens_model_of_any_driver_with_zero_coefficients_is_a_pinhole() {
        for model in [
            "inverse_brown_conrady",
            "Inverse Brown Conrady",
            "modified_brown_conrady",
            "brown_conrady",
            "rational_polynomial",
            "None",
            "plumb_bob",
        ] {
            let mut info = intrinsics_to_msg(Default::default(), &CAMERA);
            info.distortion_model = model.into();
            assert_eq!(intrinsics_from_msg(&info).unwrap(), CAMERA, "{model}");
        }
    }

    #[test]
    fn images_of_our_own_are_read_back() {
        let depth_m = [0.25, 1.5, 0.0, 2.0];
        let mut read = Vec::new();
        for image in [depth_to_msg, depth_to_msg_mm]
            .map(|make| make(Default::default(), &CAMERA, &depth_m).unwrap())
        {
            depth_from_msg(&image, &mut read).unwrap();
            assert_eq!(read, depth_m);
        }
        let mut rgb = Vec::new();
        let image = color_to_msg(Default::default(), &CAMERA, (0..12).collect()).unwrap();
        color_from_msg(&image, &CAMERA, &mut rgb).unwrap();
        assert_eq!(rgb, (0..12).collect::<Vec<u8>>());
        let info = intrinsics_to_msg(Default::default(), &CAMERA);
        assert_eq!(intrinsics_from_msg(&info).unwrap(), CAMERA);
    }

    #[test]
    fn images_that_do_not_fit_are_refused_by_field() {
        let mut rgb = Vec::new();
        let mut refusal = |image: sensor_msgs::Image| {
            color_from_msg(&image, &CAMERA, &mut rgb)
                .unwrap_err()
                .to_string()
        };
        let good = padded("rgb8", 0, 6, &[0; 12]);
        assert_eq!(
            refusal(sensor_msgs::Image {
                encoding: "yuv422".into(),
                ..good.clone()
            }),
            "encoding is \"yuv422\", expected rgb8, bgr8, rgba8, bgra8 or mono8"
        );
        assert_eq!(
            refusal(sensor_msgs::Image {
                width: 3,
                ..good.clone()
            }),
            "width is 3, expected 2"
        );
        assert_eq!(
            refusal(padded("rgb8", 0, 6, &[0; 11])),
            "data has 11 elements, expected 12"
        );
        assert_eq!(
            refusal(padded("rgb8", 0, 5, &[0; 10])),
            "step is 5, expected at least 6 for 2 pixels"
        );
        refusal(padded("rgb8", 0, u32::MAX, &[0; 10]));
    }

    #[test]
    fn the_distortion_of_a_calibration_is_read() {
        let rational = [0.5, -2.6, 0.0007, -0.0002, 1.5, 0.4, -2.4, 1.4];
        for distortion in [
            Distortion::plumb_bob([0.1, -0.2, 0.003, -0.004, 0.05]),
            Distortion::rational(rational),
            Distortion::equidistant([0.1, -0.02, 0.003, -0.001]),
        ] {
            let camera = Intrinsics {
                distortion,
                ..CAMERA
            };
            let info = intrinsics_to_msg(Default::default(), &camera);
            assert_eq!(info.distortion_model, distortion.model());
            assert_eq!(intrinsics_from_msg(&info).unwrap(), camera);
        }
        let lens = Distortion::plumb_bob([0.1, -0.2, 0.003, -0.004, 0.05]);
        let camera = Intrinsics {
            distortion: lens,
            ..CAMERA
        };
        let mut info = intrinsics_to_msg(Default::default(), &camera);
        // The polynomial in the denominator is 1.
        info.distortion_model = "rational_polynomial".into();
        info.d.extend([0.0; 3]);
        assert_eq!(intrinsics_from_msg(&info).unwrap(), camera);
        // Four coefficients are three radial ones less.
        info.distortion_model = "plumb_bob".into();
        info.d.truncate(4);
        let read = intrinsics_from_msg(&info).unwrap().distortion;
        assert_eq!(read, Distortion::plumb_bob([0.1, -0.2, 0.003, -0.004, 0.0]));
        // None, in the ways in which drivers say so.
        info.d.clear();
        assert!(intrinsics_from_msg(&info).unwrap().distortion.is_none());
        info.distortion_model.clear();
        assert!(intrinsics_from_msg(&info).unwrap().distortion.is_none());
    }

    #[test]
    fn calibrations_beyond_the_model_are_refused() {
        let good = intrinsics_to_msg(Default::default(), &CAMERA);
        let refusal = |spoil: fn(&mut sensor_msgs::CameraInfo)| {
            let mut info = good.clone();
            spoil(&mut info);
            intrinsics_from_msg(&info).unwrap_err().to_string()
        };
        assert!(refusal(|info| info.d[1] = f64::NAN).starts_with("d[1] is not finite"));
        assert!(refusal(|info| info.d.push(0.1)).starts_with("d is"));
        assert!(refusal(|info| info.d.truncate(2)).starts_with("d is"));
        for (model, field) in [
            ("equidistant", "d is"),
            ("rational_polynomial", "d is"),
            ("inverse_brown_conrady", "distortion_model is"),
            ("omnidirectional", "distortion_model is"),
        ] {
            let mut info = good.clone();
            info.d[0] = 0.1;
            info.distortion_model = model.to_owned();
            let error = intrinsics_from_msg(&info).unwrap_err().to_string();
            assert!(error.starts_with(field) && error.contains(model), "{error}");
        }
        assert!(
            refusal(|info| {
                info.distortion_model.clear();
                info.d[0] = 0.1;
            })
            .starts_with("distortion_model is \"\"")
        );
        assert!(refusal(|info| info.k[1] = 0.1).starts_with("k is"));
        assert!(refusal(|info| info.k[0] = f64::NAN).starts_with("k[0] is not finite"));
        assert!(refusal(|info| info.k[4] = -1.0).starts_with("k[4] is"));
        assert!(refusal(|info| info.binning_x = 2).starts_with("binning_x is"));
        assert!(refusal(|info| info.roi.width = 1).starts_with("roi is"));
        assert!(refusal(|info| info.r[1] = 1.0).starts_with("r is"));
    }
}
