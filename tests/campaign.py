"""A fault campaign: faults at random moments of motions, with a monitor that does not know the executor.

python tests/campaign.py --faults 20 --seed 1 --json

A cell is the simulated one as hardware behaves, the executor and the watchdog; the campaign plays everybody else. A few faults follow
each other in one cell: the motion that shows that the arm goes on after a fault is the one that the next fault breaks off. The same seed
draws the same faults at the same moments. Faults of the network need network namespaces; where the machine allows none, they are left out.

--cells runs so many cells side by side, each in a process of its own; faults that are alike follow each other in one.

--planted runs executors with a planted fault instead, and says which of them the monitor catches.
"""

from __future__ import annotations

import argparse
import collections
import concurrent.futures
import dataclasses
import json
import pathlib
import queue
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import lossy_link
from campaign_cell import Bench, Layout, begin, begin_from_home, recover, working_cell
from campaign_faults import (
    FAULTS,
    GONE,
    LAYOUTS,
    Fault,
    another_executor,
    approval_of_another,
    kill_executor,
    robot,
    spoofed_approvals,
    stop,
    stop_naming_no_proposal,
    stop_while_suction_is_on,
    superseded_approval,
    unapproved_way_home,
)
from fault_monitor import Kind, Violation

# How long the arm is watched after a fault.
WATCH_S = 2.5
# A motion of these proposals takes some 10 s.
LATEST_S = 9.0
# How much of the executor's log is shown after a violation.
LOG_CHARACTERS = 3000
# Faults that follow each other in one cell.
FAULTS_OF_A_CELL = 8

# Faults planted in the executor: what exposes each, how long after the motion has begun, and what the monitor has to say of it.
PLANTED = {
    "MovesUnapproved": (stop, 1.0, Kind.UNAPPROVED),
    "AnyApproval": (superseded_approval, 1.0, Kind.UNAPPROVED),
    "AnyOperator": (approval_of_another, 1.0, Kind.UNAPPROVED),
    "ApprovesSuperseded": (superseded_approval, 1.0, Kind.UNAPPROVED),
    "ApprovesTwice": (spoofed_approvals, 1.0, Kind.UNAPPROVED),
    "IgnoresStop": (stop, 0.5, Kind.AFTER_STOP),
    "IgnoresStopOfAnother": (stop_naming_no_proposal, 0.5, Kind.AFTER_STOP),
    "AnswersWithoutCancel": (stop, 0.5, Kind.AFTER_STOP),
    "GoesOnAfterStop": (stop, 0.5, Kind.AFTER_STOP),
    "GoesOnAfterFault": (robot("protective_stop"), 0.5, Kind.AFTER_STOP),
    "DropsOnStop": (stop_while_suction_is_on, 1.0, Kind.DROPPED),
    "HomeUnasked": (unapproved_way_home, 1.0, Kind.AFTER_STOP),
    # The approach takes some 1.4 s: killed in its beginning, it goes on for longer than the watchdog takes.
    "NoHeartbeat": (kill_executor, 0.2, Kind.AFTER_STOP),
    "SecondExecutor": (another_executor, 1.0, Kind.TWO_GOALS),
}


def inject(bench: Bench, fault: Fault, moment_s: float) -> str:
    """Injects a fault so long after the arm has begun to move. Returns how it went on."""
    bench.operator.spin(moment_s)
    bench.exposed_s.append(time.monotonic())
    fault(bench)
    bench.operator.spin(WATCH_S)
    recover(bench)
    went_on = begin_from_home(bench)
    return f"resumed{went_on.removeprefix('moves')}" if went_on.startswith("moves") else went_on


@dataclasses.dataclass(frozen=True)
class Planned:
    """A fault that is to be injected so long after a motion has begun."""

    number: int
    fault: Fault
    moment_s: float

    @property
    def layout(self) -> Layout:
        """The cell that it needs."""
        return LAYOUTS.get(self.fault, Layout.ONE_HOST)


def drawn(count: int, seed: int, among: list[Fault]) -> list[Planned]:
    """So many faults and their moments. Every kind comes once before any comes again."""
    draw = random.Random(seed)
    kinds: list[Fault] = []
    while len(kinds) < count:
        kinds += draw.sample(among, len(among))
    return [Planned(number, fault, draw.uniform(0.0, LATEST_S)) for number, fault in enumerate(kinds[:count])]


@dataclasses.dataclass
class Injected:
    """What came of a fault: a line of the log."""

    seed: int
    number: int
    fault: str
    moment_s: float
    # How it went on; empty where it hung.
    went_on: str
    hung: str = ""
    # The kinds and words of what must not happen.
    violations: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    # What the monitor heard before the first of them.
    history: list[str] = dataclasses.field(default_factory=list)


def run_cells(faults: list[Planned], seed: int, until_s: float = float("inf")) -> Iterator[Injected]:
    """Injects faults, some in each cell, until a monotonic time is over; says each with what came of it on standard error."""
    left = list(faults)
    while left and time.monotonic() < until_s:
        layout = left[0].layout
        waiting, went_on = len(left), ""
        try:
            # With it every approval away from home is refused for that reason, which would hide others: so it is in every second cell.
            needs_home = left[0].number % 2 == 1 or layout is Layout.WHOLE_GRAPH
            with working_cell(layout, seed=left[0].number, needs_home=needs_home) as bench:
                went_on = begin(bench)
                for _ in range(FAULTS_OF_A_CELL):
                    goes_on = went_on.startswith(("moves", "resumed")) and time.monotonic() < until_s
                    if not left or left[0].layout is not layout or not goes_on:
                        break
                    planned = left.pop(0)
                    line = injected(planned, seed)
                    known = len(bench.monitor.violations)
                    try:
                        line.went_on = went_on = inject(bench, planned.fault, planned.moment_s)
                    except (TimeoutError, AssertionError) as error:
                        line.hung = went_on = str(error) or type(error).__name__
                        print_logs(bench)
                    bench.catch_up()
                    found = bench.monitor.violations[known:]
                    line.violations = [(violation.kind.value, violation.text) for violation in found][:5]
                    if found:
                        line.history = found[0].history
                        print_logs(bench)
                    print(f"{json.dumps(dataclasses.asdict(line))}", file=sys.stderr, flush=True)
                    yield line
        except TimeoutError as error:
            went_on = str(error)
        if len(left) == waiting and time.monotonic() < until_s:
            # The cell did not get ready, or its first motion did not begin.
            line = injected(left.pop(0), seed)
            line.hung = f"no cell that works: {went_on}"
            print(f"{json.dumps(dataclasses.asdict(line))}", file=sys.stderr, flush=True)
            yield line


def print_logs(bench: Bench) -> None:
    """The ends of the nodes' logs, on standard error."""
    nodes = {"suction_executor": bench.executor, "goal_oracle": bench.oracle, **bench.graph}
    for name, node in nodes.items():
        if node:
            print(f"{name}'s log:\n{node.log()[-LOG_CHARACTERS:]}", file=sys.stderr, flush=True)


def injected(planned: Planned, seed: int) -> Injected:
    """A fault of which nothing is known yet."""
    return Injected(seed, planned.number, planned.fault.__name__, round(planned.moment_s, 3), "")


def summed(lines: list[Injected], faults: int, seed: int) -> dict[str, object]:
    """The result of a campaign."""
    counts = collections.Counter(kind.value for kind in Kind for line in lines if kind.value in dict(line.violations))
    return {
        "faults": faults,
        "seed": seed,
        "runs": len(lines),
        "resumed": sum(line.went_on.startswith("resumed") for line in lines),
        "refused": sum(bool(line.went_on) and not line.went_on.startswith("resumed") for line in lines),
        **{kind.value: counts[kind.value] for kind in Kind},
        "hung_runs": sum(bool(line.hung) for line in lines),
        "violations": [
            f"fault {line.number} of seed {line.seed}: {line.fault} at {line.moment_s:.2f} s: {line.violations[0][1]}"
            for line in lines
            if line.violations
        ],
    }


def run_side_by_side(faults: list[Planned], arguments: list[str], cells: int, until_s: float) -> Iterator[Injected]:
    """The same with so many cells at a time, each in a process of its own: middleware remembers the network of its process's first cell.

    `arguments`: the command line by which the processes draw the same faults.
    """
    shares = [
        share[first : first + FAULTS_OF_A_CELL]
        for layout in Layout
        if (share := [planned for planned in faults if planned.layout is layout])
        for first in range(0, len(share), FAULTS_OF_A_CELL)
    ]
    shares.sort(key=lambda share: share[0].number)
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    failed: list[int] = []
    processes: list[subprocess.Popen[str]] = []

    def run(share: list[Planned]) -> None:
        minutes = (until_s - time.monotonic()) / 60.0
        if minutes <= 0.0:
            return
        command = [sys.executable, __file__, *arguments, "--minutes", str(minutes), "--lines"]
        command += ["--numbers", *(str(planned.number) for planned in share)]
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
            processes.append(process)
            for line in process.stdout:
                lines.put(line)
        if process.returncode:
            failed.append(process.returncode)

    def run_all() -> None:
        with concurrent.futures.ThreadPoolExecutor(cells) as pool:
            list(pool.map(run, shares))
        lines.put(None)

    threading.Thread(target=run_all, daemon=True).start()
    try:
        while (line := lines.get()) is not None:
            yield Injected(**json.loads(line))
    finally:
        for process in processes:
            # Where this process is told to end.
            process.terminate()
    if failed:
        raise SystemExit(f"{len(failed)} of {len(shares)} processes ended with an error: see above")


def campaign(
    count: int,
    seed: int,
    among: list[Fault] = FAULTS,
    log: pathlib.Path | None = None,
    minutes: float = float("inf"),
    no_network: str = "",
    cells: int = 1,
) -> dict[str, object]:
    """Injects so many faults. With a log, those that are in it are not injected again, and the result is of all of them.

    `no_network`: why faults of the network are left out, if they are. `cells`: how many run side by side.
    """
    faults = drawn(count, seed, among)
    done = read_log(log, faults, seed) if log and log.exists() else []
    known = {line.number for line in done}
    if no_network:
        print(f"faults of the network are left out: {no_network}", file=sys.stderr, flush=True)
    left_out = {planned.number for planned in faults if no_network and planned.layout is Layout.TWO_HOSTS}
    until_s = time.monotonic() + 60.0 * minutes
    left = [planned for planned in faults if planned.number not in known | left_out]
    arguments = ["--faults", str(count), "--seed", str(seed), "--kinds", *(fault.__name__ for fault in among)]
    for line in run_side_by_side(left, arguments, cells, until_s):
        done.append(line)
        if log:
            with log.open("a") as file:
                print(json.dumps(dataclasses.asdict(line)), file=file)
    return {**summed(done, count, seed), "left_out": len(left_out - known)}


def read_log(log: pathlib.Path, faults: list[Planned], seed: int) -> list[Injected]:
    """The faults of a campaign that were injected before. An error where they are those of another program."""
    done = []
    for number, text in enumerate(log.read_text().splitlines(), 1):
        line = Injected(**json.loads(text))
        if line.seed != seed or line.number >= len(faults):
            continue
        expected = faults[line.number]
        if (line.fault, line.moment_s) != (expected.fault.__name__, round(expected.moment_s, 3)):
            raise SystemExit(
                f"{log}:{number}: fault {line.number} of seed {seed} is {line.fault} at {line.moment_s} s, "
                f"expected {expected.fault.__name__} at {expected.moment_s:.3f} s: written by another version of the campaign"
            )
        done.append(line)
    return done


def planted_campaign(only: str | None = None) -> dict[str, Violation | None]:
    """Runs the executor with each planted fault; what the monitor says of it, nothing where it is missed or takes it for something else."""
    caught: dict[str, Violation | None] = {}
    for planted, (fault, moment_s, expected) in PLANTED.items():
        if only not in (None, planted):
            continue
        with working_cell(planted=planted) as bench:
            try:
                begin(bench)
                inject(bench, fault, moment_s)
            except (TimeoutError, AssertionError) as error:
                print(f"{planted}: the run hangs: {error}", file=sys.stderr, flush=True)
            bench.catch_up()
            found = bench.monitor.violations
            first = next((violation for violation in found if violation.kind == expected), None)
            caught[planted] = first
            said = f"MISSED {list(map(str, found[:3]))}"
            if first:
                said = f"{expected.value} after {first.at_s - bench.exposed_by(first.at_s):.2f} s: {first}"
        print(f"{planted}: {fault.__name__}: {said}", file=sys.stderr, flush=True)
    return caught


def same_situations(seed: int) -> list[str]:
    """What the monitor says of the shipped executor where those with planted faults are caught: nothing."""
    situations = {fault.__name__: Planned(number, fault, moment_s) for number, (fault, moment_s, _) in enumerate(PLANTED.values())}
    result = summed(list(run_cells(list(situations.values()), seed)), len(situations), seed)
    hung = [f"{result['hung_runs']} runs hung"] if result["hung_runs"] else []
    return [*result["violations"], *hung]


def main() -> int:
    # What was started is ended then too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=pathlib.Path, help="append a line of JSON for each fault; those in the file are left out")
    names = {fault.__name__: fault for fault in [*FAULTS, *GONE]}
    usual = [fault.__name__ for fault in FAULTS]
    parser.add_argument("--kinds", nargs="+", choices=names, default=usual, metavar="KIND", help=f"only these: {', '.join(names)}")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="end after so long; with --log the next call goes on")
    parser.add_argument("--cells", type=int, default=1, help="how many cells run side by side; each takes a fifth of a core")
    parser.add_argument("--numbers", type=int, nargs="+", help="only the faults of these numbers")
    parser.add_argument("--lines", action="store_true", help="print each fault and what came of it as a line of JSON, and no result")
    parser.add_argument("--planted", action="store_true", help="run executors with planted faults: each has to be caught")
    parser.add_argument("--only", choices=PLANTED, help="with --planted: this fault alone")
    parser.add_argument("--json", action="store_true", help="print the result as one line of JSON")
    given = parser.parse_args()
    among = [names[name] for name in given.kinds]
    if given.lines:
        lossy_link.in_own_network()
        faults = [planned for planned in drawn(given.faults, given.seed, among) if not given.numbers or planned.number in given.numbers]
        for line in run_cells(faults, given.seed, time.monotonic() + 60.0 * given.minutes):
            print(json.dumps(dataclasses.asdict(line)), flush=True)
        return 0
    if given.planted:
        caught = planted_campaign(given.only)
        missed = [planted for planted, violation in caught.items() if not violation]
        unplanted = [] if given.only else same_situations(given.seed)
        result = {"planted": len(caught), "caught": len(caught) - len(missed), "missed": missed, "unplanted": unplanted}
        failed = bool(missed or unplanted)
    else:
        no_network = lossy_link.why_not()
        result = campaign(given.faults, given.seed, among, given.log, given.minutes, no_network, given.cells)
        failed = bool(result["violations"] or result["hung_runs"])
    print(json.dumps(result) if given.json else "\n".join(f"{name}: {value}" for name, value in result.items()))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
