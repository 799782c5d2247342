//! The numbers of a perturbation, from a file.

use serde::{Deserialize, Serialize};
use std::path::Path;

/// A model of what cameras do, as in `config/perturbations/`. Every field is given; there are no defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Perturbation {
    /// Noise of the depth.
    pub depth: Depth,
    /// Pixels at the edges of objects.
    pub edges: Edges,
    /// Holes anywhere.
    pub holes: Holes,
    /// Noise, gain and tint of the colours.
    pub color: Color,
    /// Direction of the light.
    pub light: Light,
    /// Errors of the calibration.
    pub extrinsics: Extrinsics,
    /// Chance that one of the cameras is missing in an episode.
    pub missing_camera_chance: f64,
    /// Objects that are no part of the task.
    pub clutter: Clutter,
    /// Frames that a fusion takes the median of.
    pub frames: usize,
}

/// Noise of a stereo depth camera: the disparity, focal length times baseline over depth, is wrong by a part of a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Depth {
    /// Standard deviation of the disparity (px); 0 for none.
    pub disparity_noise_px: f64,
    /// Focal length of the stereo pair (px).
    pub focal_px: f64,
    /// Baseline of the stereo pair (m).
    pub baseline_m: f64,
    /// Size of the patches that are wrong alike [px of the image].
    pub patch_px: f64,
    /// Share of the variance that is the same in all frames of a session.
    pub constant_share: f64,
    /// Smallest step of the disparity (px); 0 for none.
    pub disparity_step_px: f64,
    /// Smallest step of the depth (m); 0 for none.
    pub unit_m: f64,
    /// Nearer than this nothing is measured (m).
    pub min_m: f64,
    /// Farther than this nothing is measured (m).
    pub max_m: f64,
}

/// What happens within some pixels of a step in the depth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Edges {
    /// A difference of neighbours from which on it is an edge (m).
    pub step_m: f64,
    /// How far from the edge pixels are affected (px).
    pub width_px: usize,
    /// Share of these pixels that lie somewhere between the near and the far side: flying pixels.
    pub flying_share: f64,
    /// Share of these pixels without depth.
    pub hole_share: f64,
}

/// Square patches without depth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Holes {
    /// Share of the image without depth.
    pub share: f64,
    /// Edge length of a patch (px).
    pub size_px: usize,
}

/// Colours.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Color {
    /// Standard deviation of each channel of each pixel, of 255.
    pub noise: f64,
    /// Greatest relative change of the brightness of a camera.
    pub gain: f64,
    /// Greatest relative change of one channel of a camera besides.
    pub tint: f64,
}

/// Light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Light {
    /// Greatest angle between the light and where it usually comes from (rad).
    pub turn_rad: f64,
}

/// Errors of the calibration that the fusion uses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extrinsics {
    /// Standard deviation of the position along each axis (m).
    pub shift_m: f64,
    /// Standard deviation of the rotation about each axis (rad).
    pub turn_rad: f64,
}

/// Boxes on the table that are no part of the task: seen, but nothing touches them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Clutter {
    /// Greatest number of boxes.
    pub max_count: usize,
    /// Shortest edge (m).
    pub min_size_m: f64,
    /// Longest edge (m).
    pub max_size_m: f64,
}

/// Why a perturbation cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PerturbationError {
    /// The file cannot be read.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: String,
        /// The reason.
        source: std::io::Error,
    },
    /// It is not the YAML of a perturbation.
    #[error("{path}: {field}: {reason}")]
    Content {
        /// The file.
        path: String,
        /// The field.
        field: String,
        /// What was found and expected.
        reason: String,
    },
}

impl Perturbation {
    /// Reads a file.
    pub fn load(path: &Path) -> Result<Self, PerturbationError> {
        let name = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| PerturbationError::File {
            path: name.clone(),
            source,
        })?;
        Self::parse(&name, &text)
    }

    /// Reads the text of a file; `path` names it in errors.
    pub fn parse(path: &str, text: &str) -> Result<Self, PerturbationError> {
        let content = |field: String, reason: String| PerturbationError::Content {
            path: path.to_owned(),
            field,
            reason,
        };
        let yaml = serde_yaml_ng::Deserializer::from_str(text);
        let model: Self = serde_path_to_error::deserialize(yaml)
            .map_err(|error| content(error.path().to_string(), error.inner().to_string()))?;
        model
            .check()
            .map_err(|(field, reason)| content(field.to_owned(), reason))?;
        Ok(model)
    }

    /// The first field out of range, and what was expected.
    fn check(&self) -> Result<(), (&'static str, String)> {
        let Self {
            depth,
            edges,
            holes,
            color,
            light,
            extrinsics,
            clutter,
            ..
        } = self;
        let ranges = [
            (
                "depth.disparity_noise_px",
                depth.disparity_noise_px,
                0.0,
                2.0,
            ),
            ("depth.focal_px", depth.focal_px, 50.0, 5000.0),
            ("depth.baseline_m", depth.baseline_m, 0.005, 1.0),
            ("depth.patch_px", depth.patch_px, 1.0, 64.0),
            ("depth.constant_share", depth.constant_share, 0.0, 1.0),
            ("depth.disparity_step_px", depth.disparity_step_px, 0.0, 1.0),
            ("depth.unit_m", depth.unit_m, 0.0, 0.1),
            ("depth.min_m", depth.min_m, 0.0, 5.0),
            ("depth.max_m", depth.max_m, depth.min_m, 100.0),
            ("edges.step_m", edges.step_m, 1e-4, 1.0),
            ("edges.width_px", edges.width_px as f64, 1.0, 8.0),
            ("edges.flying_share", edges.flying_share, 0.0, 1.0),
            ("edges.hole_share", edges.hole_share, 0.0, 1.0),
            ("holes.share", holes.share, 0.0, 0.5),
            ("holes.size_px", holes.size_px as f64, 1.0, 64.0),
            ("color.noise", color.noise, 0.0, 64.0),
            ("color.gain", color.gain, 0.0, 0.9),
            ("color.tint", color.tint, 0.0, 0.9),
            ("light.turn_rad", light.turn_rad, 0.0, 1.2),
            ("extrinsics.shift_m", extrinsics.shift_m, 0.0, 0.1),
            ("extrinsics.turn_rad", extrinsics.turn_rad, 0.0, 0.2),
            (
                "missing_camera_chance",
                self.missing_camera_chance,
                0.0,
                1.0,
            ),
            ("clutter.max_count", clutter.max_count as f64, 0.0, 50.0),
            ("clutter.min_size_m", clutter.min_size_m, 0.002, 0.2),
            (
                "clutter.max_size_m",
                clutter.max_size_m,
                clutter.min_size_m,
                0.2,
            ),
            ("frames", self.frames as f64, 1.0, 31.0),
        ];
        for (field, value, from, to) in ranges {
            // Not a number is in no range.
            if !(from..=to).contains(&value) {
                return Err((field, format!("expected {from} to {to}, found {value}")));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REALSENSE: &str = include_str!("../../../config/perturbations/realsense.yaml");

    #[test]
    fn the_shipped_files_are_read_and_grow_from_mild_to_harsh() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/perturbations");
        let [mild, realsense, harsh] = ["mild", "realsense", "harsh"]
            .map(|name| Perturbation::load(&folder.join(format!("{name}.yaml"))).unwrap());
        for (less, more) in [(&mild, &realsense), (&realsense, &harsh)] {
            assert!(less.depth.disparity_noise_px < more.depth.disparity_noise_px);
            assert!(less.edges.hole_share <= more.edges.hole_share);
            assert!(less.extrinsics.shift_m < more.extrinsics.shift_m);
            assert!(less.color.gain < more.color.gain);
        }
    }

    #[test]
    fn every_number_of_the_shipped_files_has_a_comment() {
        for text in [
            include_str!("../../../config/perturbations/mild.yaml"),
            REALSENSE,
            include_str!("../../../config/perturbations/harsh.yaml"),
        ] {
            let lines: Vec<&str> = text.lines().collect();
            for (index, line) in lines.iter().enumerate() {
                let (_, value) = line.split_once(": ").unwrap_or_default();
                if !line.trim_start().starts_with('#') && value.parse::<f64>().is_ok() {
                    assert!(lines[index - 1].trim_start().starts_with('#'), "{line}");
                }
            }
        }
    }

    #[test]
    fn unknown_missing_and_impossible_fields_are_refused_by_file_and_field() {
        let refusal = |from: &str, to: &str| {
            assert!(REALSENSE.contains(from), "{from}");
            let text = REALSENSE.replacen(from, to, 1);
            Perturbation::parse("some.yaml", &text)
                .unwrap_err()
                .to_string()
        };
        for (from, to, field) in [
            ("  patch_px:", "  patch_pixels:", "depth"),
            ("  tint:", "  # tint:", "color"),
            ("frames:", "frames: many #", "frames"),
            ("  share:", "  share: 0.9 #", "holes.share"),
            ("  focal_px:", "  focal_px: .nan #", "depth.focal_px"),
            (
                "  flying_share:",
                "  flying_share: -0.1 #",
                "edges.flying_share",
            ),
        ] {
            let refusal = refusal(from, to);
            let expected = format!("some.yaml: {field}");
            assert!(refusal.starts_with(&expected), "{refusal}");
        }
        let missing = Perturbation::load(Path::new("no/such.yaml")).unwrap_err();
        assert!(missing.to_string().starts_with("no/such.yaml: "));
    }
}
