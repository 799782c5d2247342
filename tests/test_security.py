"""DDS security: nodes with certificates hear each other and nobody else, and none starts unprotected.

What does not work yet: docs/guide/security.md.

rclpy's wheels have Fast DDS without its security plugins, so that every script here is one without a certificate.
"""

from __future__ import annotations

import os
import pathlib
import shutil
import signal
import subprocess
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator

import pytest
import yaml
from cell_operator import Operator
from peer import Peer
from processes import REPOSITORY, Process
from sctn_msgs.msg import StepConfirmation

POLICY = REPOSITORY / "config/sros2_policy.xml"


def run_keystore(*arguments: object, days: int = 3650) -> None:
    command = [REPOSITORY / "tests/keystore.sh", *map(str, arguments)]
    subprocess.run(command, env={**os.environ, "DAYS": str(days)}, check=True)


def topics_of(profile: ET.Element, group: ET.Element, right: str) -> tuple[list[str], list[str]]:
    """What sros2 makes of a group of a policy: DDS topics that may be published, and subscribed to."""
    publish: list[str] = []
    subscribe: list[str] = []
    for element in group:
        name = element.text or ""
        namespace = profile.attrib["ns"].rstrip("/")
        if name.startswith("~"):
            name = f"{namespace}/{profile.attrib['node']}{name[1:]}"
        elif not name.startswith("/"):
            name = f"{namespace}/{name}"
        match group.tag, right:
            case "topics", "publish":
                publish.append(f"rt{name}")
            case "topics", "subscribe":
                subscribe.append(f"rt{name}")
            case "services", _:
                asks, answers = [f"rq{name}Request"], [f"rr{name}Reply"]
                publish += asks if right == "request" else answers
                subscribe += answers if right == "request" else asks
            case "actions", _:
                calls = ("cancel_goal", "get_result", "send_goal")
                asks = [f"rq{name}/_action/{call}Request" for call in calls]
                answers = [f"rr{name}/_action/{call}Reply" for call in calls]
                answers += [f"rt{name}/_action/feedback", f"rt{name}/_action/status"]
                publish += asks if right == "call" else answers
                subscribe += answers if right == "call" else asks
            case other:
                raise ValueError(f"{POLICY}: {other}")
    return publish, subscribe


def permissions(enclave: ET.Element, domain: int) -> str:
    """The permissions document of an enclave, as `ros2 security create_permission` makes it."""
    path = enclave.attrib["path"]
    publish, subscribe = ["ros_discovery_info"], ["ros_discovery_info"]
    for profile in enclave.iter("profile"):
        for group in profile:
            for right, word in group.attrib.items():
                assert word == "ALLOW", word
                publishes, subscribes = topics_of(profile, group, right)
                publish += publishes
                subscribe += subscribes
    return document(path, domain, publish, subscribe)


def document(enclave: str, domain: int, publish: list[str], subscribe: list[str]) -> str:
    """A permissions document of DDS topics."""
    lists = "".join(
        f"<{right}><topics>{''.join(f'<topic>{topic}</topic>' for topic in sorted(set(topics)))}</topics></{right}>"
        for right, topics in (("publish", publish), ("subscribe", subscribe))
    )
    return (
        f'<dds><permissions><grant name="{enclave}"><subject_name>CN={enclave}</subject_name>'
        "<validity><not_before>2020-01-01T00:00:00</not_before><not_after>2037-01-01T00:00:00</not_after></validity>"
        f"<allow_rule><domains><id>{domain}</id></domains>{lists}</allow_rule><default>DENY</default></grant></permissions></dds>"
    )


@pytest.fixture(scope="module")
def keystore(domain: int, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("security") / "keystore"
    run_keystore("create", folder, domain)
    for enclave in ET.parse(POLICY).iter("enclave"):
        document = folder / "permissions.xml"
        document.write_text(permissions(enclave, domain))
        run_keystore("enclave", folder, enclave.attrib["path"], document)
    return folder


def protected(name: str, keystore: pathlib.Path, domain: int, logs: pathlib.Path, *arguments: object, typed: bool = False) -> Process:
    """Starts an executable where security is enforced."""
    variables = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(keystore),
    }
    return Process(name, list(map(str, arguments)), domain, logs, variables=variables, typed=typed)


StartProtected = Callable[..., Process]


@pytest.fixture
def start_protected(keystore: pathlib.Path, domain: int, tmp_path: pathlib.Path) -> Iterator[StartProtected]:
    """The same with the keystore of this module; it is ended after the test."""
    processes: list[Process] = []

    def start(name: str, *arguments: object, typed: bool = False) -> Process:
        processes.append(protected(name, keystore, domain, tmp_path, *arguments, typed=typed))
        return processes[-1]

    yield start
    for process in reversed(processes):
        process.end()
        print(f"--- {process.name} (exit code {process.exit_code})\n{process.log()}")


def test_the_policy_of_the_nodes_is_current(start) -> None:
    check = start("sctn", "interfaces", "--policy", "--check", POLICY)
    assert check.wait(90.0) == 0, check.errors()


def test_protected_nodes_hear_each_other_and_no_script_without_a_certificate(
    start_protected: StartProtected, keystore: pathlib.Path, operator: Operator, domain: int, tmp_path: pathlib.Path
) -> None:
    everything = ["ros_discovery_info", "rt/*", "rq/*", "rr/*"]
    (tmp_path / "permissions.xml").write_text(document("/sctn/rosbag2_recorder", domain, everything, everything))
    run_keystore("enclave", keystore, "/sctn/rosbag2_recorder", tmp_path / "permissions.xml")
    start_protected("sim_workcell", "--ros-args", "--enclave", "/sctn/sim_workcell", "-p", f"problems_dir:={REPOSITORY}/config/problems")
    executor = start_protected("suction_executor", "--ros-args", "--enclave", "/sctn/suction_executor", "-p", "use_sim_time:=true")
    recorder = start_protected("sctn", "bag", "record", "/joint_states", "/step_confirmation", "--out", tmp_path / "bag")
    operator.until(lambda: ": active" in executor.errors(), "active executor", 60.0)
    # Somebody without a certificate speaks, and is heard by those who are as it is.
    with Peer(domain, "outsider") as outsider, Peer(domain, "intruder") as intruder:
        heard = outsider.listen(StepConfirmation, "step_confirmation")
        voice = intruder.speak(StepConfirmation, "step_confirmation")
        end = time.monotonic() + 8.0
        while time.monotonic() < end:
            voice.publish(StepConfirmation(decision=StepConfirmation.STOP))
            operator.spin(0.1)
        outsider.until(lambda: len(heard) > 20, "the words of the intruder")
        assert intruder.node.count_subscribers("/step_confirmation") == 1, "somebody protected listens to the intruder"
    recorder.signal(signal.SIGINT)
    assert recorder.wait(20.0) == 0, recorder.log()
    counts = {topic["topic_metadata"]["name"]: topic["message_count"] for topic in topics_of_bag(tmp_path / "bag")}
    assert counts["/joint_states"] > 10, counts
    assert not counts.get("/step_confirmation"), counts
    # To such a script nothing of the cell is there.
    assert not any(operator.received.values()), {topic: len(said) for topic, said in operator.received.items()}
    assert not operator.states


def topics_of_bag(folder: pathlib.Path) -> list[dict]:
    """What a bag's metadata says of its topics."""
    return yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]["topics_with_message_count"]


@pytest.mark.parametrize("file", ["cert.pem", "key.pem", "governance.p7s", "permissions.p7s", "identity_ca.cert.pem"])
def test_a_node_whose_files_are_missing_does_not_start(start_protected: StartProtected, keystore: pathlib.Path, file: str) -> None:
    path = keystore / "enclaves/sctn/suction_executor" / file
    aside = path.with_suffix(".aside")
    os.rename(path, aside)
    try:
        executor = start_protected("suction_executor", "--ros-args", "--enclave", "/sctn/suction_executor")
        assert executor.wait(20.0) == 1
        assert str(path) in executor.errors(), executor.errors()
    finally:
        os.rename(aside, path)


EXECUTOR = "enclaves/sctn/suction_executor"


def foreign(folder: pathlib.Path, domain: int) -> pathlib.Path:
    """The executor's enclave in a keystore of another authority."""
    run_keystore("create", folder, domain)
    (folder / "permissions.xml").write_text(document("/sctn/suction_executor", domain, ["rt/*"], ["rt/*"]))
    run_keystore("enclave", folder, "/sctn/suction_executor", folder / "permissions.xml")
    return folder / EXECUTOR


@pytest.mark.parametrize(
    ("file", "what", "change"),
    [
        ("key.pem", "private key", lambda own, other, _: shutil.copy(other / "key.pem", own / "key.pem")),
        ("cert.pem", "Signature", lambda own, _, far: [shutil.copy(far / file, own / file) for file in ("cert.pem", "key.pem")]),
        ("cert.pem", "PEM", lambda own, *_: (own / "cert.pem").write_text("nothing")),
        ("permissions.p7s", "Signature", lambda own, _, far: shutil.copy(far / "permissions.p7s", own / "permissions.p7s")),
        ("permissions.p7s", "CN=/sctn/suction_executor", lambda own, other, _: shutil.copy(other / "permissions.p7s", own)),
        ("governance.p7s", "hash", lambda own, *_: replace(own / "governance.p7s", "participants>false", "participants>true")),
        ("crl.pem", "not supported", lambda own, *_: (own / "crl.pem").write_text("")),
    ],
)
def test_a_node_whose_files_are_wrong_does_not_start(
    keystore: pathlib.Path, domain: int, tmp_path: pathlib.Path, file: str, what: str, change: Callable[..., object]
) -> None:
    copy = tmp_path / "keystore"
    shutil.copytree(keystore, copy)
    change(copy / EXECUTOR, copy / "enclaves/sctn/sim_workcell", foreign(tmp_path / "foreign", domain))
    executor = protected("suction_executor", copy, domain, tmp_path, "--ros-args", "--enclave", "/sctn/suction_executor")
    try:
        assert executor.wait(20.0) == 1
        assert str(copy / EXECUTOR / file) in executor.errors() and what in executor.errors(), executor.errors()
    finally:
        executor.end()


def replace(file: pathlib.Path, old: str, new: str) -> None:
    """Changes a signed document."""
    text = file.read_bytes()
    assert old.encode() in text
    file.unlink()
    file.write_bytes(text.replace(old.encode(), new.encode()))


def test_a_certificate_that_has_expired_starts_nothing(domain: int, tmp_path: pathlib.Path) -> None:
    keystore = tmp_path / "keystore"
    run_keystore("create", keystore, domain)
    (tmp_path / "permissions.xml").write_text(document("/sctn/suction_executor", domain, ["rt/*"], ["rt/*"]))
    run_keystore("enclave", keystore, "/sctn/suction_executor", tmp_path / "permissions.xml", days=-1)
    executor = protected("suction_executor", keystore, domain, tmp_path, "--ros-args", "--enclave", "/sctn/suction_executor")
    try:
        assert executor.wait(20.0) == 1
        assert "cert.pem" in executor.errors() and "not valid now" in executor.errors(), executor.errors()
    finally:
        executor.end()


def test_a_node_without_an_enclave_does_not_start(start_protected: StartProtected) -> None:
    executor = start_protected("suction_executor")
    assert executor.wait(20.0) == 1
    assert "enclave /" in executor.errors(), executor.errors()


def test_a_command_whose_permissions_do_not_allow_a_topic_says_which(start_protected: StartProtected) -> None:
    # The watchdog's permissions do not let it confirm.
    terminal = start_protected("sctn", "operate", "--", "--enclave", "/sctn/motion_watchdog", typed=True)
    assert terminal.wait(20.0) == 1
    assert "step_confirmation" in terminal.errors() or "ecurity" in terminal.errors(), terminal.errors()
