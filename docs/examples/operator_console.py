"""A client of the operator's console: joins, takes control, approves each proposal, and asks at the terminal whether each step succeeded.

python operator_console.py 'http://127.0.0.1:8750/#token=...'

Only the standard library. docs/operator_console.openapi.yaml describes the API.
"""

from __future__ import annotations

import json
import struct
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from typing import Any


class Refused(Exception):
    """The console did not do what was asked for; the text says why and what to do."""

    def __init__(self, status: int, reason: str, advice: str) -> None:
        super().__init__(f"{reason} {advice}")
        self.status, self.reason, self.advice = status, reason, advice


class Console:
    """A viewer of the console whose page has this address."""

    def __init__(self, address: str, name: str) -> None:
        url = urllib.parse.urlsplit(address)
        self._api = f"{url.scheme}://{url.netloc}/api/v1"
        self._headers = {"Authorization": f"Bearer {urllib.parse.parse_qs(url.fragment)['token'][0]}"}
        joined = self.post("sessions", name=name)
        self.viewer: int = joined["viewer"]
        self._headers["X-Session"] = joined["session"]

    def state(self) -> dict[str, Any]:
        """The state of run, robot and people."""
        return json.loads(self._request("state")[0])

    def post(self, path: str, **body: Any) -> dict[str, Any]:
        """Asks for something; an error where it is refused."""
        answer, _ = self._request(path, json.dumps(body).encode())
        return json.loads(answer) if answer else {}

    def take_control(self) -> None:
        """Takes control from whoever decides now."""
        self.post("operator", action="take", **{"from": self.state()["operator"]})

    def decide(self, decision: str, proposal: dict[str, Any] | None = None) -> None:
        """`approve`, `reject`, `advance`, `retry` or `stop`."""
        self.post("decisions", decision=decision, proposal_id=proposal["id"] if proposal else "0")

    def recover(self, how: str) -> dict[str, Any]:
        """Has the executor plan how the arm comes home: `home`, or `put_down` what is held first. Returns `home` of the state."""
        self.post(how)
        end = time.monotonic() + 60.0
        while time.monotonic() < end:
            state = self.state()
            home, motion = state["home"], state["motion"]
            if home and home["recovery"] == how and motion and motion["proposal_id"] == home["proposal_id"]:
                return home
            time.sleep(0.05)
        raise TimeoutError(f"{how} was not proposed: {state['notices'][-1:]}")

    def decide_recovery(self, decision: str, home: dict[str, Any]) -> None:
        """`approve` or `reject` what `recover` has returned."""
        self.post("decisions", decision=decision, proposal_id=home["proposal_id"])

    def heightmap(self, which: str) -> tuple[int, int, bytes, list[float]]:
        """Rows, columns, colours (3 bytes for each cell) and heights [m] of `present`, `goal`, `goal-2` and so on."""
        body, headers = self._request(f"heightmaps/{which}")
        rows, cols = int(headers["X-Rows"]), int(headers["X-Cols"])
        cells = rows * cols
        return rows, cols, body[: 3 * cells], list(struct.unpack(f"<{cells}f", body[3 * cells :]))

    def wait(self, *phases: str, timeout_s: float = 120.0) -> dict[str, Any]:
        """The first state in one of these phases."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            state = self.state()
            if state["phase"] in phases:
                return state
            time.sleep(0.05)
        raise TimeoutError(f"none of the phases {phases} within {timeout_s} s; the phase is {state['phase']}: {state['headline']}")

    def _request(self, path: str, body: bytes | None = None) -> tuple[bytes, Any]:
        headers = {**self._headers, "Content-Type": "application/json"}
        request = urllib.request.Request(f"{self._api}/{path}", body, headers)
        try:
            with urllib.request.urlopen(request, timeout=10) as response:
                return response.read(), response.headers
        except urllib.error.HTTPError as error:
            raise Refused(error.code, **json.loads(error.read())) from None


def main() -> None:
    """Approves until all steps are done."""
    console = Console(sys.argv[1], "operator_console.py")
    console.take_control()
    while (state := console.wait("proposed", "awaiting_confirmation", "complete"))["phase"] != "complete":
        proposal = state["proposal"]
        if state["phase"] == "proposed":
            print(f"{state['headline']}: pick {proposal['pick']}, place {proposal['place']}")
            try:
                console.decide("approve", proposal)
            except Refused as refused:
                print(refused)
                time.sleep(0.5)
        else:
            succeeded = input("Did the step succeed? [y/n] ") == "y"
            console.decide("advance" if succeeded else "retry", proposal)
    print("all steps are done")


if __name__ == "__main__":
    main()
