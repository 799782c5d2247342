"""The graph on a real cell: beside the drivers of the UR5 and of the cameras, which have to run already.

ros2 launch sctn_nodes real_cell.launch.py demonstration:=/path/to/bag calibration:=/path/to/calibration.yaml

The UR driver: `ros2 launch ur_robot_driver ur_control.launch.py ur_type:=ur5 robot_ip:=...`. It publishes joint_states, tf and
robot_description of the arm. Where nothing tells where the work cell's other frames are, publish_cell:=true has robot_state_publisher
tell what urdf/workcell.urdf says; not together with the driver's own, or the arm has two parents.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    def share(*path: str) -> PathJoinSubstitution:
        return PathJoinSubstitution([FindPackageShare("sctn_nodes"), *path])

    def node(executable: str, condition: IfCondition | None = None, **parameters: object) -> Node:
        return Node(
            package="sctn_nodes",
            executable=executable,
            namespace=LaunchConfiguration("namespace"),
            parameters=[share("config", f"{executable}.yaml"), {"use_sim_time": False, **parameters}],
            condition=condition,
            output="screen",
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the cell's nodes and topics."),
            DeclareLaunchArgument(
                "demonstration",
                default_value="",
                description="Bag whose images are the goals; empty: wait for goal_oracle/load_demonstration or capture_goal.",
            ),
            DeclareLaunchArgument(
                "checkpoint",
                default_value=share("config", "checkpoints", "ten_problems.safetensors"),
                description="Policy.",
            ),
            DeclareLaunchArgument(
                "calibration",
                default_value="",
                description="Poses of the cameras, as config/calibration.yaml explains; empty: from /tf_static.",
            ),
            DeclareLaunchArgument("urdf", default_value=share("urdf", "workcell.urdf"), description="The work cell, calibrated."),
            DeclareLaunchArgument(
                "contact",
                default_value="until_action",
                description="What tells that the tool touches something: until_action (e-Series), vacuum or height.",
            ),
            DeclareLaunchArgument("publish_cell", default_value="false", description="Whether to publish the cell's description and tf."),
            DeclareLaunchArgument("console", default_value="true", description="Whether to serve the operator's page."),
            DeclareLaunchArgument("console_port", default_value="8750", description="Port of the operator's page; 0: the system chooses."),
            DeclareLaunchArgument("rviz", default_value="false", description="Whether to show the cell in RViz."),
            node("camera_fusion", calibration=LaunchConfiguration("calibration")),
            node("goal_oracle", demonstration=LaunchConfiguration("demonstration"), start_empty=True),
            node(
                "gctn_policy",
                checkpoint=LaunchConfiguration("checkpoint"),
                urdf=LaunchConfiguration("urdf"),
                observation_needs_home=True,
            ),
            # Time of the wall clock; the tip slows down above what was seen, and what the driver says may not be old.
            node(
                "suction_executor",
                urdf=LaunchConfiguration("urdf"),
                observation_max_age_s=1.0,
                observation_needs_home=True,
                contact={"slow_from_m": 0.03},
                driver={"contact": LaunchConfiguration("contact"), "status_max_age_s": 0.2},
            ),
            node("motion_watchdog"),
            node(
                "operator_console",
                condition=IfCondition(LaunchConfiguration("console")),
                port=LaunchConfiguration("console_port"),
                demonstration=LaunchConfiguration("demonstration"),
            ),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                namespace=LaunchConfiguration("namespace"),
                parameters=[{"robot_description": ParameterValue(Command(["cat ", LaunchConfiguration("urdf")]), value_type=str)}],
                condition=IfCondition(LaunchConfiguration("publish_cell")),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", share("config", "sctn.rviz")],
                namespace=LaunchConfiguration("namespace"),
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
