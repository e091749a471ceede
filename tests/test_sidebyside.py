"""Work side by side: the same answers in the same order, whatever becomes of the processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from excite.sidebyside import cores, forked, in_turn


def test_answers_come_in_order_and_from_elsewhere() -> None:
    def told(k: int) -> tuple[int, bool]:
        return k, os.getpid() == here

    here = os.getpid()
    calls = [partial(told, k) for k in range(7)]
    assert list(in_turn(calls)) == [(k, True) for k in range(7)]
    assert [k for k, _ in forked(calls)] == list(range(7))
    if cores() > 1:
        assert not any(own for _, own in forked(calls))
    assert list(forked(calls[:1])) == [(0, True)]
    assert list(forked([])) == []


def test_what_a_process_does_not_finish_is_done_here(tmp_path: Path) -> None:
    def killed(once: Path) -> str:
        if not once.exists():
            once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return "done"

    if cores() > 1:
        assert list(forked([partial(killed, tmp_path / name) for name in "abc"])) == ["done"] * 3

    def fails() -> str:
        raise ValueError("no such thing")

    calls: list[Callable[[], str]] = [lambda: "fine", fails]
    with pytest.raises(ValueError, match="no such thing"):
        list(forked(calls))


def test_nothing_is_left_running_behind_an_interrupt(tmp_path: Path) -> None:
    def waits(name: str) -> None:
        (tmp_path / name).write_text(str(os.getpid()))
        signal.pause()

    answers = forked([lambda: None, partial(waits, "second"), partial(waits, "third")])
    next(answers)
    answers.close()  # type: ignore[attr-defined]
    for path in tmp_path.iterdir():
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)
