"""DDS security: a cell whose nodes have certificates and the permissions of config/sros2_policy.xml works, and hears nobody else.

rclpy's wheels have Fast DDS without its security plugins, so that every script here is one without a certificate. CycloneDDS of Debian has
them.
"""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator

import pytest
from cell_operator import Operator
from peer import Peer
from processes import REPOSITORY, Process, environment
from sctn_msgs.msg import StepConfirmation

POLICY = REPOSITORY / "config/sros2_policy.xml"


def run_keystore(*arguments: object) -> None:
    subprocess.run([REPOSITORY / "tests/keystore.sh", *map(str, arguments)], check=True)


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


StartProtected = Callable[..., Process]


@pytest.fixture
def start_protected(keystore: pathlib.Path, domain: int, tmp_path: pathlib.Path) -> Iterator[StartProtected]:
    """Starts an executable where security is enforced."""
    processes: list[Process] = []
    variables = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(keystore),
    }

    def start(name: str, *arguments: object, typed: bool = False) -> Process:
        process = Process(name, list(map(str, arguments)), domain, tmp_path, variables=variables, typed=typed)
        processes.append(process)
        return process

    yield start
    for process in reversed(processes):
        process.end()
        print(f"--- {process.name} (exit code {process.exit_code})\n{process.log()}")


def test_the_policy_of_the_nodes_is_current(start) -> None:
    check = start("sctn", "interfaces", "--policy", "--check", POLICY)
    assert check.wait(90.0) == 0, check.errors()


def test_a_protected_cell_carries_out_a_step_and_hears_no_script_without_a_certificate(
    start, start_protected: StartProtected, operator: Operator, domain: int, tmp_path: pathlib.Path
) -> None:
    demos = start("sctn", "demos", "--problem", "placing", "--episodes", 1, "--seed", 0, "--out", tmp_path / "demos")
    assert demos.wait(120.0) == 0, demos.log()
    (demonstration,) = [file.parent for file in (tmp_path / "demos").rglob("metadata.yaml")]
    given = {
        "sim_workcell": ["-p", "problem:=placing", "-p", "seed:=10000", "-p", f"problems_dir:={REPOSITORY}/config/problems"],
        "camera_fusion": [],
        "gctn_policy": ["-p", f"checkpoint:={REPOSITORY}/config/checkpoints/ten_problems.safetensors"],
        "suction_executor": [],
        "motion_watchdog": [],
        "goal_oracle": ["-p", f"demonstration:={demonstration}"],
    }
    nodes = {
        name: start_protected(name, "--ros-args", "--enclave", f"/sctn/{name}", "-p", "use_sim_time:=true", *more)
        for name, more in given.items()
    }
    terminal = start_protected("sctn", "operate", "--use-sim-time", typed=True)

    def shows(text: str, timeout_s: float = 60.0) -> None:
        ended = [node.name for node in [*nodes.values(), terminal] if node.exit_code is not None]
        assert not ended, f"{ended} ended"
        operator.until(lambda: text in terminal.output(), f"{text!r} in {terminal.output()!r}", timeout_s)

    shows("carry it out?")
    # The intruder speaks, and is heard by those who are as it is.
    with Peer(domain, "outsider") as outsider, Peer(domain, "intruder") as intruder:
        heard = outsider.listen(StepConfirmation, "step_confirmation")
        voice = intruder.speak(StepConfirmation, "step_confirmation")
        end = time.monotonic() + 120.0
        asked = 0
        while "did the step succeed?" not in terminal.output():
            if terminal.output().count("carry it out?") > asked:
                # Again where the view has changed meanwhile.
                asked = terminal.output().count("carry it out?")
                terminal.type("y")
            voice.publish(StepConfirmation(decision=StepConfirmation.STOP))
            operator.spin(0.05)
            assert "STOPPED" not in terminal.output(), terminal.output()
            assert time.monotonic() < end and terminal.exit_code is None, terminal.log()
        outsider.until(lambda: len(heard) > 20, "the stops of the intruder")
        assert {said.operator_name for said in heard} == {""}, "an outsider heard the operator's confirmation"
    # To such a script the cell is not there at all.
    assert not any(operator.received.values()), {topic: len(said) for topic, said in operator.received.items()}
    assert not operator.states
    terminal.type("y")
    shows("step 2/")


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


def test_a_node_without_an_enclave_does_not_start(start_protected: StartProtected) -> None:
    executor = start_protected("suction_executor")
    assert executor.wait(20.0) == 1
    assert "enclave /" in executor.errors(), executor.errors()


def test_a_command_whose_permissions_do_not_allow_a_topic_says_which(start_protected: StartProtected) -> None:
    # The watchdog's permissions do not let it confirm.
    terminal = start_protected("sctn", "operate", "--", "--enclave", "/sctn/motion_watchdog", typed=True)
    assert terminal.wait(20.0) == 1
    assert "step_confirmation" in terminal.errors() or "ecurity" in terminal.errors(), terminal.errors()


# Debian's and Ubuntu's CycloneDDS has its security plugins; the wheel of the other tests does not.
PLUGINS = next(pathlib.Path("/usr/lib").glob("*/libddsc0*/"), None)
HAS_CYCLONEDDS = PLUGINS is not None and all(map(shutil.which, ("idlc", "cc")))


def cyclonedds_settings(keystore: pathlib.Path | None, enclave: str) -> str:
    """As rmw_cyclonedds_cpp makes them; without a keystore unprotected."""
    security = ""
    if keystore:
        folder = keystore / f"enclaves{enclave}"

        def plugin(element: str, name: str, init: str, **files: str) -> str:
            library = f'<Library path="{PLUGINS}/libdds_security_{name}.so" initFunction="init_{init}" finalizeFunction="finalize_{init}"/>'
            return f"<{element}>{library}{''.join(f'<{key}>file:{folder}/{file}</{key}>' for key, file in files.items())}</{element}>"

        security = f"""<Security>
          {plugin("Authentication", "auth", "authentication",
                  IdentityCA="identity_ca.cert.pem", IdentityCertificate="cert.pem", PrivateKey="key.pem")}
          {plugin("Cryptographic", "crypto", "crypto")}
          {plugin("AccessControl", "ac", "access_control",
                  PermissionsCA="permissions_ca.cert.pem", Governance="governance.p7s", Permissions="permissions.p7s")}
        </Security>"""  # fmt: skip
    return f"""<CycloneDDS><Domain>
      <General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
      <Discovery>
        <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
        <Peers><Peer address="127.0.0.1"/></Peers>
      </Discovery>{security}
    </Domain></CycloneDDS>"""


@pytest.mark.skipif(not HAS_CYCLONEDDS, reason="no CycloneDDS with security: apt install cyclonedds-dev cyclonedds-tools")
def test_a_peer_on_cyclonedds_is_heard_with_a_certificate_and_not_without(
    start_protected: StartProtected, keystore: pathlib.Path, domain: int, tmp_path: pathlib.Path
) -> None:
    sources = REPOSITORY / "tests/secure_cyclone"
    subprocess.run(["idlc", "-l", "c", sources / "step_confirmation.idl"], cwd=tmp_path, check=True)
    build = ["cc", "-o", "peer", sources / "peer.c", "step_confirmation.c", "-I.", "-lddsc"]
    subprocess.run(build, cwd=tmp_path, check=True)
    everything = ["ros_discovery_info", "rt/*", "rq/*", "rr/*"]
    for enclave in ("/echo", "/cyclone"):
        (tmp_path / "permissions.xml").write_text(document(enclave, domain, everything, everything))
        run_keystore("enclave", keystore, enclave, tmp_path / "permissions.xml")
    start_protected("interface_echo", "--ros-args", "--enclave", "/echo")

    def peer(settings: str, seconds: int) -> subprocess.CompletedProcess[str]:
        variables = {**environment(domain), "CYCLONEDDS_URI": settings}
        command = [tmp_path / "peer", str(domain), str(seconds)]
        return subprocess.run(command, env=variables, capture_output=True, text=True, timeout=seconds + 60.0)

    protected = peer(cyclonedds_settings(keystore, "/cyclone"), 60)
    assert protected.returncode == 0, protected.stderr
    assert protected.stdout == "4711 a person on CycloneDDS\n"
    # Longer than it took to be heard.
    unprotected = peer(cyclonedds_settings(None, ""), 10)
    assert unprotected.returncode == 1, unprotected.stdout + unprotected.stderr
    again = peer(cyclonedds_settings(keystore, "/cyclone"), 60)
    assert again.returncode == 0, again.stderr
