//! Names of the topics of RGB-D cameras, as their drivers choose them.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The driver of the cameras of a cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CameraPreset {
    /// `sim_workcell`: depth is registered to colour.
    #[default]
    Simulated,
    /// realsense-ros as it comes: depth is that of the left infrared imager, to be registered by `/tf_static` and its own calibration.
    Realsense,
    /// realsense-ros with `align_depth.enable:=true`: the driver registers depth to colour.
    RealsenseAligned,
    /// OrbbecSDK_ROS2, with `depth_registration:=true` or without.
    Orbbec,
    /// zed-ros2-wrapper since 5.1: colour of the left imager, rectified, and the depth of its pixels.
    Zed,
    /// zed-ros2-wrapper before 5.1.
    #[serde(rename = "zed_5_0")]
    Zed50,
}

/// Names of the topics of one camera, relative to the cell's namespace.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CameraTopicNames {
    /// Colour images.
    pub color: String,
    /// Depth images.
    pub depth: String,
    /// Calibration of the colour images.
    pub color_info: String,
    /// Calibration of the depth images, needed where they have a frame of their own.
    pub depth_info: String,
}

/// What follows the camera's name in the topics of a driver.
struct Endings {
    preset: CameraPreset,
    name: &'static str,
    color: &'static str,
    color_info: &'static str,
    depth: &'static str,
    depth_info: &'static str,
}

/// realsense-ros: `camera_namespace:='' camera_name:=NAME`; OrbbecSDK_ROS2: `camera_name:=NAME`; zed-ros2-wrapper: `camera_name:=NAME`, whose
/// node is called zed_node.
static ENDINGS: [Endings; 6] = [
    Endings {
        preset: CameraPreset::Simulated,
        name: "simulated",
        color: "color/image_raw",
        color_info: "color/camera_info",
        depth: "depth/image_rect_raw",
        depth_info: "depth/camera_info",
    },
    Endings {
        preset: CameraPreset::Realsense,
        name: "realsense",
        color: "color/image_raw",
        color_info: "color/camera_info",
        depth: "depth/image_rect_raw",
        depth_info: "depth/camera_info",
    },
    Endings {
        preset: CameraPreset::RealsenseAligned,
        name: "realsense_aligned",
        color: "color/image_raw",
        color_info: "color/camera_info",
        depth: "aligned_depth_to_color/image_raw",
        depth_info: "aligned_depth_to_color/camera_info",
    },
    Endings {
        preset: CameraPreset::Orbbec,
        name: "orbbec",
        color: "color/image_raw",
        color_info: "color/camera_info",
        depth: "depth/image_raw",
        depth_info: "depth/camera_info",
    },
    Endings {
        preset: CameraPreset::Zed,
        name: "zed",
        color: "zed_node/rgb/color/rect/image",
        color_info: "zed_node/rgb/color/rect/camera_info",
        depth: "zed_node/depth/depth_registered",
        depth_info: "zed_node/depth/camera_info",
    },
    Endings {
        preset: CameraPreset::Zed50,
        name: "zed_5_0",
        color: "zed_node/rgb/image_rect_color",
        color_info: "zed_node/rgb/camera_info",
        depth: "zed_node/depth/depth_registered",
        depth_info: "zed_node/depth/camera_info",
    },
];

impl CameraPreset {
    fn endings(self) -> &'static Endings {
        let found = ENDINGS.iter().find(|endings| endings.preset == self);
        found.unwrap_or(&ENDINGS[0])
    }

    /// Names of all presets.
    pub fn names() -> impl Iterator<Item = &'static str> {
        ENDINGS.iter().map(|endings| endings.name)
    }

    /// What follows the camera's name in the topics of its colour and depth images.
    pub fn image_endings(self) -> [&'static str; 2] {
        [self.endings().color, self.endings().depth]
    }

    /// The topics of the camera of a name.
    pub fn topics(self, camera: &str) -> CameraTopicNames {
        let endings = self.endings();
        let topic = |ending: &str| format!("{camera}/{ending}");
        CameraTopicNames {
            color: topic(endings.color),
            depth: topic(endings.depth),
            color_info: topic(endings.color_info),
            depth_info: topic(endings.depth_info),
        }
    }
}

impl fmt::Display for CameraPreset {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.endings().name)
    }
}

/// No preset has the name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?}, expected simulated, realsense, realsense_aligned, orbbec, zed or zed_5_0")]
pub struct UnknownPreset(String);

impl FromStr for CameraPreset {
    type Err = UnknownPreset;

    fn from_str(name: &str) -> Result<Self, UnknownPreset> {
        let found = ENDINGS.iter().find(|endings| endings.name == name);
        found
            .map(|endings| endings.preset)
            .ok_or_else(|| UnknownPreset(name.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_has_its_name_and_the_topics_of_its_driver() {
        for endings in &ENDINGS {
            let preset: CameraPreset = endings.name.parse().unwrap();
            assert_eq!(preset, endings.preset);
            assert_eq!(preset.to_string(), endings.name);
            let unknown = "?".parse::<CameraPreset>().unwrap_err().to_string();
            assert!(unknown.contains(endings.name), "{unknown}");
        }
        let aligned = CameraPreset::RealsenseAligned.topics("cell/front");
        assert_eq!(aligned.depth, "cell/front/aligned_depth_to_color/image_raw");
        let zed = CameraPreset::Zed.topics("left");
        assert_eq!(zed.color, "left/zed_node/rgb/color/rect/image");
        assert_eq!(zed.color_info, "left/zed_node/rgb/color/rect/camera_info");
        assert_eq!(
            CameraPreset::Orbbec.topics("right").depth,
            "right/depth/image_raw"
        );
    }
}
