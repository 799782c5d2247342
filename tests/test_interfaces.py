"""docs/interfaces.md says what the nodes have."""

from __future__ import annotations

from processes import REPOSITORY


def test_the_page_of_interfaces_is_current(start) -> None:
    check = start("sctn", "interfaces", "--check", REPOSITORY / "docs/interfaces.md")
    assert check.wait(90.0) == 0, check.errors()
