//! What ros2-client leaves to us: context, ROS arguments, parameters, QoS profiles, spinning.
