"""An operator on CycloneDDS, without ROS: the messages are dataclasses, and it approves what the policy proposes.

It prints a line for each proposal, result and reward, and ends when the problem is solved.
"""

import argparse
import time
from dataclasses import dataclass

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, float64, int32, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Duration(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Pose2D(IdlStruct, typename="geometry_msgs::msg::dds_::Pose2D_"):
    x: float64
    y: float64
    theta: float64


@dataclass
class PrimitiveSettings(IdlStruct, typename="sctn_msgs::msg::dds_::PrimitiveSettings_"):
    clearance_m: float64
    lift_m: float64
    travel_m_s: float64
    carry_m_s: float64
    descend_m_s: float64
    acceleration_m_s2: float64


@dataclass
class Heightmap(IdlStruct, typename="sctn_msgs::msg::dds_::Heightmap_"):
    header: Header
    rows: uint32
    cols: uint32
    pixel_size_m: float64
    origin: Point
    z_min_m: float64
    z_max_m: float64
    rgb: sequence[uint8]
    height_m: sequence[float32]
    views: uint32
    coverage: float32


@dataclass
class Goal(IdlStruct, typename="sctn_msgs::msg::dds_::Goal_"):
    header: Header
    problem: str
    demonstration: str
    step: uint32
    step_count: uint32
    attempt: uint32
    complete: bool
    module: str
    settings: PrimitiveSettings
    heightmap: Heightmap
    previous: Heightmap


@dataclass
class PickPlace(IdlStruct, typename="sctn_msgs::msg::dds_::PickPlace_"):
    header: Header
    id: uint64
    problem: str
    step: uint32
    attempt: uint32
    pick: Pose2D
    place: Pose2D
    pick_score: float32
    place_score: float32
    settings: PrimitiveSettings
    module: str
    success_probability: float32
    checkpoint: str
    author: str
    done_probability: float32


@dataclass
class StepConfirmation(IdlStruct, typename="sctn_msgs::msg::dds_::StepConfirmation_"):
    header: Header
    proposal_id: uint64
    decision: uint8
    operator_name: str


@dataclass
class StepResult(IdlStruct, typename="sctn_msgs::msg::dds_::StepResult_"):
    header: Header
    proposal_id: uint64
    outcome: uint8
    reason: str
    duration: Duration
    proposal_status: uint8


@dataclass
class Reward(IdlStruct, typename="sctn_msgs::msg::dds_::Reward_"):
    header: Header
    delta: float64
    total: float64
    complete: bool


APPROVE, ADVANCE, RETRY = 1, 3, 4
RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
# As rmw_cyclonedds_cpp sends: CDR of the first version.
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)
EVENT = Qos(RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(10), CDR)
LATCHED = Qos(RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1), CDR)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", type=int, required=True, help="ROS domain id")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds until it gives up")
    arguments = parser.parse_args()

    participant = DomainParticipant(arguments.domain)

    def reader(name: str, of: type[IdlStruct], qos: Qos) -> DataReader:
        return DataReader(participant, Topic(participant, f"rt/{name}", of, qos=qos), qos=qos)

    goals = reader("goal", Goal, LATCHED)
    proposals = reader("pick_place", PickPlace, LATCHED)
    results = reader("step_result", StepResult, EVENT)
    rewards = reader("reward", Reward, EVENT)
    listener = Matched()
    topic = Topic(participant, "rt/step_confirmation", StepConfirmation, qos=EVENT)
    confirmations = DataWriter(participant, topic, qos=EVENT, listener=listener)
    current = heard = 0
    complete = False

    def say(decision: int) -> None:
        # Executor, oracle and policy: none may miss it.
        while listener.count < 3:
            time.sleep(0.05)
        header = Header(stamp=Time(0, 0), frame_id="")
        confirmations.write(StepConfirmation(header, current, decision, "a person on CycloneDDS"))

    end = time.monotonic() + arguments.timeout
    while time.monotonic() < end:
        for goal in goals.take(N=8):
            colors, heights = len(goal.heightmap.rgb), len(goal.heightmap.height_m)
            print(f"goal {goal.step} of {goal.step_count}: {colors} bytes of colour, {heights} heights", flush=True)
        for result in results.take(N=8):
            heard = result.proposal_id
            print(f"result {result.outcome} {result.reason}", flush=True)
        for reward in rewards.take(N=8):
            print(f"reward {reward.total:.2f}", flush=True)
            say(ADVANCE if reward.delta > 0 else RETRY)
            complete = reward.complete
        if complete and heard == current:
            return
        for proposal in proposals.take(N=8):
            current = proposal.id
            print(f"step {proposal.step}: {proposal.pick.x:.3f} {proposal.pick.y:.3f}", flush=True)
            say(APPROVE)
        time.sleep(0.01)
    raise SystemExit("the problem was not solved in time")


class Matched(Listener):
    """Counts the subscribers of a publisher."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def on_publication_matched(self, _writer: DataWriter, status) -> None:
        self.count = status.current_count


if __name__ == "__main__":
    main()
