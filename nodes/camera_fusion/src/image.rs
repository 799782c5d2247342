//! Images of the drivers, as the synchronizer reads them.

use frame_synchronizer::Image;
use heightmap::Intrinsics;
use msgs::convert::{self, ConvertError};
use msgs::sensor_msgs;

/// A message, decoded only when it is fused.
pub struct ImageMessage(pub sensor_msgs::Image);

impl Image for ImageMessage {
    type Error = ConvertError;

    fn frame(&self) -> &str {
        &self.0.header.frame_id
    }

    fn size_px(&self) -> (usize, usize) {
        (self.0.width as usize, self.0.height as usize)
    }

    fn read_color(&self, intrinsics: &Intrinsics, rgb: &mut Vec<u8>) -> Result<(), ConvertError> {
        convert::color_from_msg(&self.0, intrinsics, rgb)
    }

    fn read_depth(&self, depth_m: &mut Vec<f32>) -> Result<(), ConvertError> {
        convert::depth_from_msg(&self.0, depth_m)
    }
}
