"""The graph on the simulated cell.

ros2 launch sctn_nodes simulated_cell.launch.py demonstration:=/path/to/bag problem:=placing seed:=10000 rviz:=true

A person approves on the operator's page, whose address is printed; README.md shows a program that does, in rclpy.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    def share(*path: str) -> PathJoinSubstitution:
        return PathJoinSubstitution([FindPackageShare("sctn_nodes"), *path])

    def node(executable: str, condition: IfCondition | None = None, **parameters: object) -> Node:
        return Node(
            package="sctn_nodes",
            executable=executable,
            # Counts where ROS_SECURITY_ENABLE is true: docs/guide/security.md.
            ros_arguments=["--enclave", f"/sctn/{executable}"],
            namespace=LaunchConfiguration("namespace"),
            parameters=[share("config", f"{executable}.yaml"), {"use_sim_time": True, **parameters}],
            condition=condition,
            output="screen",
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the cell's nodes and topics."),
            DeclareLaunchArgument("problem", default_value="placing", description="Problem in config/problems."),
            DeclareLaunchArgument("seed", default_value="10000", description="Seed of the scene; test seeds start at 10000."),
            DeclareLaunchArgument(
                "demonstration",
                default_value="",
                description="Bag whose images are the goals (`sctn demos`); empty: wait for goal_oracle/load_demonstration.",
            ),
            DeclareLaunchArgument(
                "checkpoint",
                default_value=share("config", "checkpoints", "ten_problems.safetensors"),
                description="Policy.",
            ),
            DeclareLaunchArgument("real_time_factor", default_value="1.0", description="Simulated seconds per second; 0.0: all that goes."),
            DeclareLaunchArgument("console", default_value="true", description="Whether to serve the operator's page."),
            DeclareLaunchArgument("console_port", default_value="8750", description="Port of the operator's page; 0: the system chooses."),
            DeclareLaunchArgument("rviz", default_value="false", description="Whether to show the cell in RViz."),
            node(
                "sim_workcell",
                problem=LaunchConfiguration("problem"),
                seed=LaunchConfiguration("seed"),
                problems_dir=share("config", "problems"),
                urdf=share("urdf", "workcell.urdf"),
                real_time_factor=LaunchConfiguration("real_time_factor"),
            ),
            node("camera_fusion"),
            node("goal_oracle", demonstration=LaunchConfiguration("demonstration"), start_empty=True),
            node("gctn_policy", checkpoint=LaunchConfiguration("checkpoint")),
            # Simulated cables are pulled until they lag behind.
            node("suction_executor", urdf=share("urdf", "workcell.urdf"), driver={"lag_rule": True}),
            node("motion_watchdog"),
            node(
                "operator_console",
                condition=IfCondition(LaunchConfiguration("console")),
                port=LaunchConfiguration("console_port"),
                demonstration=LaunchConfiguration("demonstration"),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", share("config", "sctn.rviz")],
                namespace=LaunchConfiguration("namespace"),
                parameters=[{"use_sim_time": True}],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
