//! Where cameras and links are, on tf, and what the robot looks like.

use std::time::Duration;

use heightmap::Camera;
use msgs::convert::ConvertError;
use msgs::std_msgs;
use msgs::tf2_msgs::TFMessage;
use node_kit::{Node, NodeError, Publisher, Qos};
use ur5::{Joints, WorkCell};

use crate::cameras::{camera_transforms, link_transforms};

/// `/tf_static`; with the robot also `/tf` and `robot_description`.
pub struct RobotPublishers {
    work_cell: WorkCell,
    world_frame: String,
    tf_static: Publisher<TFMessage>,
    /// Of the arm's links, and its description, which is kept so that late subscribers receive it.
    robot: Option<(Publisher<TFMessage>, Publisher<std_msgs::String>)>,
}

impl RobotPublishers {
    /// Offers the topics, and publishes the robot's description.
    ///
    /// # Errors
    /// The middleware refuses.
    pub fn new(
        node: &Node,
        work_cell: &WorkCell,
        world_frame: &str,
        with_robot: bool,
    ) -> Result<Self, NodeError> {
        let robot = match with_robot {
            false => None,
            true => {
                let description = node.publisher("robot_description", Qos::Latched)?;
                description.publish(std_msgs::String {
                    data: work_cell.urdf.clone(),
                });
                Some((node.publisher("/tf", Qos::Event)?, description))
            }
        };
        Ok(Self {
            work_cell: work_cell.clone(),
            world_frame: world_frame.to_owned(),
            tf_static: node.publisher("/tf_static", Qos::Latched)?,
            robot,
        })
    }

    /// Publishes where the cameras are, as their calibration has it, and the links that stand still.
    ///
    /// # Errors
    /// When the time is none of ROS.
    pub fn publish_fixed(&self, cameras: &[Camera], time: Duration) -> Result<(), ConvertError> {
        let mut fixed = camera_transforms(cameras, &self.world_frame, time)?;
        if self.robot.is_some() {
            let home = self.work_cell.arm.home;
            fixed
                .transforms
                .extend(self.links(&home, false, time)?.transforms);
        }
        self.tf_static.publish(fixed);
        Ok(())
    }

    /// Publishes where the arm's links are.
    ///
    /// # Errors
    /// When the time is none of ROS.
    pub fn publish_links(&self, joints_rad: &Joints, time: Duration) -> Result<(), ConvertError> {
        if let Some((tf, _)) = &self.robot {
            tf.publish(self.links(joints_rad, true, time)?);
        }
        Ok(())
    }

    fn links(
        &self,
        joints_rad: &Joints,
        moving: bool,
        time: Duration,
    ) -> Result<TFMessage, ConvertError> {
        link_transforms(&self.work_cell, joints_rad, moving, &self.world_frame, time)
    }
}
