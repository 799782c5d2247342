"""The operator's console killed, fuzzed, watched by many and by somebody slow. The long forms are commands:

MOMENTS=50 SECONDS=60 VIEWING_S=600 .venv/bin/python -m pytest tests/test_console_robustness.py
"""

from __future__ import annotations

import http.client
import json
import os
import pathlib
import random
import signal
import socket
import struct
import time
import urllib.parse

from cell_operator import EVENT, Operator
from console_peer import ROUTES, WebSocket, post, spoiled
from processes import Process
from sctn_msgs.msg import StepConfirmation, StepResult
from sctn_msgs.srv import ResetCell
from test_operator_console import CLIENT, console_process, slow_down, until

# Moments of a motion at which the console is killed.
MOMENTS = int(os.environ.get("MOMENTS", "3"))
# How long input is fuzzed.
SECONDS = float(os.environ.get("SECONDS", "4"))
# What it takes while it is idle is its share of a core over so many windows in a row.
IDLE_WINDOWS = 5
WINDOW_S = 1.0
# At most this share of a core.
IDLE_SHARE = 0.02
# By then it has encoded the pictures and discovered the graph, also on a busy machine.
SETTLES_WITHIN_S = 30.0
# How long ten viewers watch.
VIEWING_S = float(os.environ.get("VIEWING_S", "4"))

# The executor's presence_timeout_s, and what the arm needs to come to rest.
STOPS_WITHIN_S = 3.0


def approvable(console: CLIENT.Console, since: str | None = None) -> dict:
    """Goes on with the run until another proposal than `since` can be approved, and returns it."""

    def ready() -> dict | None:
        console.post("presence")
        state = console.state()
        phase = state["phase"]
        try:
            if phase in ("awaiting_confirmation", "fault"):
                console.decide("retry", state["proposal"])
            elif phase == "stopped":
                console.post("step", step=state["goal"]["step"])
                time.sleep(0.5)
            elif phase == "proposed" and state["proposal"]["id"] == since:
                # It was approved by a console that is no more: the executor says what became of it.
                console.decide("approve", state["proposal"])
            elif phase == "proposed" and "approve" not in state["refused"]:
                return state["proposal"]
        except CLIENT.Refused:
            time.sleep(0.1)
        return None

    return until(ready, "proposal that can be approved", 60.0)


def motion_result(operator: Operator, proposal_id: str) -> StepResult | None:
    """What became of the motion of a proposal; refusals of repeated confirmations are left out."""
    results = operator.received["step_result"]
    return next((one for one in results if str(one.proposal_id) == proposal_id and one.outcome != StepResult.REFUSED), None)


def reset(operator: Operator, name: str) -> None:
    """The cell as it was at first."""
    client = operator.node.create_client(ResetCell, "sim_workcell/reset")
    operator.until(client.service_is_ready, "sim_workcell", 30.0)
    answer = client.call_async(ResetCell.Request(request_id=name, seed=10012))
    operator.until(answer.done, "answer of sim_workcell", 30.0)
    assert answer.result().success, answer.result().message


def test_no_motion_goes_on_unattended_after_the_console_is_killed_and_the_run_goes_on(
    start, operator: Operator, tmp_path: pathlib.Path
) -> None:
    start("sctn", "launch", "--problem", "stacking", "--seed", 10012, "--operator", "none", "--require-presence")
    operator.until(operator.executor_is_ready, "executor that has checked its driver", 60.0)
    generator = random.Random(5)
    since = None
    stopped = 0
    for moment in range(MOMENTS):
        process, address = console_process(start, tmp_path / "address")
        console = CLIENT.Console(address, f"Ada {moment}")
        console.take_control()
        if not moment:
            slow_down(operator, 1.0)
        proposal = approvable(console, since)
        # The executor hears that somebody is present.
        console.post("presence")
        operator.spin(0.5)
        console.decide("approve", proposal)
        since = proposal["id"]
        # From before the arm moves until its way home.
        moment_s = time.monotonic() + generator.uniform(0.0, 4.0)
        while time.monotonic() < moment_s:
            console.post("presence")
            time.sleep(0.1)
        process.signal(signal.SIGKILL)
        killed = time.monotonic()
        result = operator.until(lambda since=since: motion_result(operator, since), "result of the motion", 30.0)
        if result.outcome == StepResult.STOPPED:
            stopped += 1
            assert time.monotonic() - killed < STOPS_WITHIN_S
        # Nothing moves from then on.
        operator.spin(0.3)
        still = operator.newest("joint_states").position
        operator.spin(0.7)
        assert max(abs(a - b) for a, b in zip(still, operator.newest("joint_states").position, strict=True)) < 1e-3
        # Somebody takes what the gripper holds, and brings the arm home.
        reset(operator, f"after moment {moment}")
    assert stopped > 0
    # The run goes on with another console.
    slow_down(operator, 0.0)
    _, address = console_process(start, tmp_path / "address")
    console = CLIENT.Console(address, "Bob")
    console.take_control()
    console.decide("approve", approvable(console, since))
    console.wait("awaiting_confirmation")


def resident_kb(process: Process) -> int:
    """Resident memory."""
    status = pathlib.Path(f"/proc/{process.pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1])


def test_random_input_of_somebody_with_the_token_moves_nothing_and_the_page_works_on(
    start, operator: Operator, tmp_path: pathlib.Path
) -> None:
    start("sctn", "launch", "--problem", "stacking", "--seed", 10014, "--operator", "none")
    process, address = console_process(start, tmp_path / "address")
    ada, eve = CLIENT.Console(address, "Ada"), CLIENT.Console(address, "Eve")
    ada.take_control()
    proposal = approvable(ada)
    said: list[StepConfirmation] = []
    operator.node.create_subscription(StepConfirmation, "step_confirmation", said.append, EVENT)
    operator.until(lambda: operator.count("pick_place"), "proposal", 30.0)
    proposals = operator.count("pick_place")
    seed = random.randrange(2**32)
    print(f"seed {seed}")
    generator = random.Random(seed)
    url = urllib.parse.urlsplit(address)
    connection = http.client.HTTPConnection(url.netloc, timeout=10)
    # Whoever sends this has the token and a session, and does not decide.
    headers = {**eve._headers, "Content-Type": "application/json"}
    begun_kb = resident_kb(process)
    end = time.monotonic() + SECONDS
    requests, messages = 0, 0
    watcher: WebSocket | None = None
    while time.monotonic() < end:
        if requests % 500 == 0:
            # Her page is open.
            ada.post("presence")
        path = generator.choice(list(ROUTES))
        status = post(connection, headers, path, spoiled(generator, ROUTES[path]))
        assert status < 500, f"seed {seed}: {path} answered {status}"
        requests += 1
        try:
            watcher = watcher or WebSocket(address, eve._headers["X-Session"])
            data = generator.choice(
                [b"", b"{}", generator.randbytes(50), b"[" * 3000, b"x" * 5000, b'{"type": "present", "visible": 1}', b'{"type": "hello"}']
            )
            watcher.send(data, generator.choice([1, 2, 9, 10, 8, 3]))
            messages += 1
        except OSError:
            watcher = None
    grown_kb = resident_kb(process) - begun_kb
    print(f"{requests} requests, {messages} messages, {grown_kb} kB more")
    assert requests > 100 and messages > 50
    assert process.exit_code is None
    # Nothing of it stays: neither in memory nor is a secret said.
    assert grown_kb < 4096
    secrets = [ada._headers["X-Session"], eve._headers["X-Session"], ada._headers["Authorization"].removeprefix("Bearer ")]
    told = process.output() + process.errors() + json.dumps(ada.state())
    assert not [secret for secret in secrets if secret in told]
    ada.post("presence")
    assert ada.state()["operator"] == ada.viewer
    assert ada.state()["proposal"]["id"] == proposal["id"]
    operator.spin(0.5)
    assert said == [] and operator.count("pick_place") == proposals
    ada.decide("approve", approvable(ada))
    ada.wait("awaiting_confirmation")


def test_messages_of_100_mb_are_refused_and_take_no_memory(start, tmp_path: pathlib.Path) -> None:
    start("sctn", "launch", "--problem", "stacking", "--seed", 10026, "--operator", "none")
    process, address = console_process(start, tmp_path / "address")
    ada = CLIENT.Console(address, "Ada")
    ada.take_control()
    approvable(ada)
    url = urllib.parse.urlsplit(address)
    before_kb = resident_kb(process)
    large = bytes(1 << 20)

    def pushed(connection: socket.socket) -> int:
        """How many of 100 MB the console takes before it hangs up."""
        sent = 0
        try:
            for _ in range(100):
                connection.sendall(large)
                sent += len(large)
        except OSError:
            pass
        return sent

    # As a WebSocket message, as one of many fragments, as a body with a length, and as one without.
    session = ada._headers["X-Session"]
    whole = WebSocket(address, session)
    whole.socket.sendall(struct.pack("!BBQ", 0x81, 0x80 | 127, 100 * len(large)) + bytes(4))
    taken = [pushed(whole.socket)]
    fragments = WebSocket(address, session)
    try:
        for number in range(100_000):
            fragments.socket.sendall(struct.pack("!BBH", 0x01 if number == 0 else 0x00, 0x80 | 126, 1000) + bytes(1004))
        raise AssertionError("100 MB in fragments were taken")
    except OSError:
        pass
    head = f"POST /api/v1/decisions HTTP/1.1\r\nHost: {url.netloc}\r\nAuthorization: {ada._headers['Authorization']}\r\n"
    head += f"X-Session: {session}\r\nContent-Type: application/json\r\n"
    for kind in ("Content-Length: 104857600\r\n\r\n", f"Transfer-Encoding: chunked\r\n\r\n{104857600:x}\r\n"):
        with socket.create_connection((url.hostname, url.port), timeout=10) as connection:
            connection.sendall((head + kind).encode())
            taken.append(pushed(connection))
    print(f"taken before the console hung up: {[round(count / 2**20) for count in taken]} MB")
    assert max(taken) < 20 * len(large)
    grown_kb = resident_kb(process) - before_kb
    print(f"{grown_kb} kB more")
    assert grown_kb < 4096
    ada.decide("approve", approvable(ada))
    ada.wait("awaiting_confirmation")


def processor_s(process: Process) -> float:
    """Time on a processor, of all threads: the process's clock, which counts nanoseconds (clock_getcpuclockid(3))."""
    return time.clock_gettime(~process.pid << 3 | 2)


def idle_share(process: Process, page: WebSocket) -> float:
    """What the process takes of a core once it has settled, with a page open.

    The share over the last windows in a row, as soon as it is small enough; else the smallest that there was in the time allowed.
    """
    shares: list[float] = []
    smallest = float("inf")
    end = time.monotonic() + SETTLES_WITHIN_S
    while smallest > IDLE_SHARE and time.monotonic() < end:
        begin_s, begun_s = processor_s(process), time.monotonic()
        while (left_s := begun_s + WINDOW_S - time.monotonic()) > 0:
            page.send(b'{"type": "present", "visible": true}')
            page.receive_until(time.monotonic() + min(0.2, left_s))
        shares.append((processor_s(process) - begin_s) / (time.monotonic() - begun_s))
        if len(shares) >= IDLE_WINDOWS:
            smallest = min(smallest, sum(shares[-IDLE_WINDOWS:]) / IDLE_WINDOWS)
    print(f"share of a core in each window: {', '.join(f'{100 * share:.1f} %' for share in shares)}")
    return smallest


def test_an_idle_console_takes_little_and_ten_viewers_and_a_slow_one_cost_no_memory_and_slow_nobody(start, tmp_path: pathlib.Path) -> None:
    start("sctn", "launch", "--problem", "stacking", "--seed", 10016, "--operator", "none")
    process, address = console_process(start, tmp_path / "address")
    ada = CLIENT.Console(address, "Ada")
    ada.take_control()
    proposal = approvable(ada)
    # A proposal waits, and one page is open.
    page = WebSocket(address, ada._headers["X-Session"])
    share = idle_share(process, page)
    page.close()
    print(f"idle: {100 * share:.1f} % of a core")
    assert share <= IDLE_SHARE

    def presence_s() -> float:
        begin = time.monotonic()
        ada.post("presence")
        return time.monotonic() - begin

    sessions = [CLIENT.Console(address, f"Viewer {number}")._headers["X-Session"] for number in range(10)]
    viewers = [WebSocket(address, session) for session in sessions]
    # It reads nothing, and its buffer is small.
    slow = WebSocket(address, ada._headers["X-Session"], receive_buffer=4096)
    took: list[float] = []

    def watch(seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for viewer in viewers:
                viewer.send(b'{"type": "present", "visible": true}')
            seen = [viewer.receive() for viewer in viewers]
            assert {state["proposal"]["id"] for state in seen} == {proposal["id"]}
            took.append(presence_s())

    # Until threads and buffers have their size.
    watch(max(2.0, VIEWING_S / 10))
    before_kb = resident_kb(process)
    took.clear()
    for part in range(10):
        watch(VIEWING_S / 10)
        print(f"after {(part + 1) * VIEWING_S / 10:.0f} s: {resident_kb(process)} kB", flush=True)
    grown_kb = resident_kb(process) - before_kb
    took.sort()
    median_s = took[len(took) // 2]
    print(f"{len(took)} rounds of ten viewers: {grown_kb} kB more")
    print(f"a request takes {1000 * median_s:.1f} ms (median), {1000 * took[-1]:.1f} ms (longest)")
    assert grown_kb < 4096
    assert median_s < 0.05
    slow.close()
    for viewer in viewers:
        viewer.close()
    ada.decide("approve", approvable(ada))
    ada.wait("awaiting_confirmation")
