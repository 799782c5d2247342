"""The graph on a real cell: beside the drivers of the UR5 and of the cameras, which have to run already.

ros2 launch sctn_nodes real_cell.launch.py urdf:=/path/to/cell.urdf arm_calibration:=/path/to/my_robot_calibration.yaml \\
    calibration:=/path/to/calibration.yaml camera_preset:=orbbec parameters:=/path/to/my_cell.yaml demonstration:=/path/to/bag

Each node reads its file in config/, then config/real_cell.yaml, then the file that `parameters` names.

First `sctn check` measures the cell, with the arm at home and the table empty. Only if every row is green does suction_executor start:
until then nothing can move. check:=false leaves that out.

The UR driver: `ros2 launch ur_robot_driver ur_control.launch.py ur_type:=ur5 robot_ip:=...`. It publishes joint_states, tf and
robot_description of the arm. Where nothing tells where the work cell's other frames are, publish_cell:=true has robot_state_publisher
tell what urdf/workcell.urdf says; not together with the driver's own, or the arm has two parents.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, LogInfo, RegisterEventHandler
from launch.conditions import IfCondition, UnlessCondition
from launch.event_handlers import OnProcessExit
from launch.substitutions import Command, EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackagePrefix, FindPackageShare


def generate_launch_description() -> LaunchDescription:
    def share(*path: str) -> PathJoinSubstitution:
        return PathJoinSubstitution([FindPackageShare("sctn_nodes"), *path])

    def node(executable: str, condition: IfCondition | UnlessCondition | None = None, **parameters: object) -> Node:
        return Node(
            package="sctn_nodes",
            executable=executable,
            # Counts where ROS_SECURITY_ENABLE is true: docs/guide/security.md.
            ros_arguments=["--enclave", f"/sctn/{executable}"],
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                share("config", f"{executable}.yaml"),
                share("config", "real_cell.yaml"),
                {"use_sim_time": False, **parameters},
                LaunchConfiguration("parameters"),
            ],
            condition=condition,
            output="screen",
        )

    def executor(condition: UnlessCondition | None = None) -> Node:
        return node(
            "suction_executor",
            condition=condition,
            urdf=LaunchConfiguration("urdf"),
            arm_calibration=LaunchConfiguration("arm_calibration"),
            stop_file=LaunchConfiguration("stop_file"),
            driver={"contact": LaunchConfiguration("contact")},
        )

    # With the parameters that the nodes have.
    check = ExecuteProcess(
        cmd=[
            PathJoinSubstitution([FindPackagePrefix("sctn_nodes"), "lib", "sctn_nodes", "sctn"]),
            *("check", "--urdf", LaunchConfiguration("urdf"), "--"),
            *("-r", ["__ns:=/", LaunchConfiguration("namespace")]),
            *("-p", ["camera_fusion:frames:=", LaunchConfiguration("frames")]),
            *("-p", ["camera_fusion:camera_preset:=", LaunchConfiguration("camera_preset")]),
            *("-p", ['camera_fusion:calibration:="', LaunchConfiguration("calibration"), '"']),
            *("-p", ["suction_executor:driver.contact:=", LaunchConfiguration("contact")]),
            *("-p", ['suction_executor:arm_calibration:="', LaunchConfiguration("arm_calibration"), '"']),
            *("--params-file", share("config", "real_cell.yaml")),
            *("--params-file", LaunchConfiguration("parameters")),
        ],
        condition=IfCondition(LaunchConfiguration("check")),
        output="screen",
    )

    def after_check(event: object, _: object) -> list:
        if event.returncode == 0:
            return [executor()]
        return [LogInfo(msg="sctn check: not every row is green, suction_executor is not started. Mend what is red and launch again.")]

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
            DeclareLaunchArgument(
                "camera_preset",
                default_value="realsense_aligned",
                description="Driver of the cameras: realsense, realsense_aligned, orbbec, zed, zed_5_0 or simulated.",
            ),
            DeclareLaunchArgument("frames", default_value="5", description="Frames of a still scene that a heightmap is the median of."),
            DeclareLaunchArgument("check", default_value="true", description="Whether the executor waits for `sctn check`."),
            DeclareLaunchArgument("urdf", default_value=share("urdf", "workcell.urdf"), description="The work cell."),
            DeclareLaunchArgument(
                "arm_calibration",
                default_value="",
                description="Factory calibration of the arm, as the UR driver's ur_calibration writes it; empty: as the URDF says.",
            ),
            DeclareLaunchArgument(
                "parameters",
                default_value=share("config", "real_cell.yaml"),
                description="File of what is different on this cell, laid out as config/real_cell.yaml; it wins over the others. What has "
                "an argument here (frames, camera_preset, calibration, contact, arm_calibration) is given by that: `sctn check` needs it.",
            ),
            DeclareLaunchArgument(
                "stop_file",
                default_value=[
                    EnvironmentVariable("ROS_HOME", default_value=[EnvironmentVariable("HOME"), "/.ros"]),
                    "/sctn/",
                    LaunchConfiguration("namespace"),
                    "/stopped",
                ],
                description="Where the executor remembers a stop over a restart; one file for each cell.",
            ),
            DeclareLaunchArgument(
                "contact",
                default_value="until_action",
                description="What tells that the tool touches something: until_action (e-Series), vacuum or height.",
            ),
            DeclareLaunchArgument("publish_cell", default_value="false", description="Whether to publish the cell's description and tf."),
            DeclareLaunchArgument("console", default_value="true", description="Whether to serve the operator's page."),
            DeclareLaunchArgument("console_port", default_value="8750", description="Port of the operator's page; 0: the system chooses."),
            DeclareLaunchArgument("rviz", default_value="false", description="Whether to show the cell in RViz."),
            RegisterEventHandler(
                OnProcessExit(target_action=check, on_exit=after_check), condition=IfCondition(LaunchConfiguration("check"))
            ),
            check,
            executor(UnlessCondition(LaunchConfiguration("check"))),
            node(
                "camera_fusion",
                calibration=LaunchConfiguration("calibration"),
                camera_preset=LaunchConfiguration("camera_preset"),
                frames=LaunchConfiguration("frames"),
            ),
            node("goal_oracle", demonstration=LaunchConfiguration("demonstration"), start_empty=True),
            node(
                "gctn_policy",
                checkpoint=LaunchConfiguration("checkpoint"),
                urdf=LaunchConfiguration("urdf"),
            ),
            node("motion_watchdog"),
            node(
                "operator_console",
                condition=IfCondition(LaunchConfiguration("console")),
                port=LaunchConfiguration("console_port"),
                camera_preset=LaunchConfiguration("camera_preset"),
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
