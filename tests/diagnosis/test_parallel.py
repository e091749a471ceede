"""Work side by side: the same answers in the same order, whatever becomes of the processes."""

from __future__ import annotations

import errno
import operator
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from excite.diagnosis import parallel, run_forked
from excite.diagnosis.parallel import run_in_turn, usable_cores


def test_answers_come_in_order_and_from_elsewhere() -> None:
    def told(k: int) -> tuple[int, bool]:
        return k, os.getpid() == here

    here = os.getpid()
    calls = [partial(told, k) for k in range(7)]
    assert list(run_in_turn(calls)) == [(k, True) for k in range(7)]
    assert [k for k, _ in run_forked(calls)] == list(range(7))
    if usable_cores() > 1:
        assert not any(own for _, own in run_forked(calls))
    assert list(run_forked(calls[:1])) == [(0, True)]
    assert list(run_forked([])) == []


def test_arrays_come_whole_and_are_ones_own() -> None:
    def made(k: int) -> dict[str, np.ndarray]:
        whole = np.random.default_rng(k).normal(size=(300, 7, 50))
        parts = {
            "turned": whole.T,
            "part": whole[::3, 1:],
            "none": whole[:0],
            "small": whole[0, 0, :3],
            "k": np.array(k),
        }
        return parts if k else {"none": np.empty(0)}

    calls = [partial(made, k) for k in range(5)]
    answers = list(run_forked(calls))
    for found, here in zip(answers, run_in_turn(calls), strict=True):
        for name, array in here.items():
            np.testing.assert_array_equal(found[name], array, strict=True)
            assert found[name].flags.writeable
            assert found[name].ctypes.data % 8 == 0
    answers[1]["turned"][:] = 0.0
    assert answers[1]["small"].any()  # its own memory beside the other array's


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")
def test_no_descriptor_stays_open(monkeypatch: pytest.MonkeyPatch) -> None:
    class Large:
        """An answer that can be sent, but not received."""

        def __reduce__(self) -> tuple[Any, ...]:
            return operator.mul, (b"0", sys.maxsize // 2)

    def opened() -> list[str]:
        return sorted(os.listdir("/proc/self/fd"))

    monkeypatch.setattr(parallel, "usable_cores", lambda: 2)
    calls = [partial(np.full, 1000, k) for k in range(4)]
    before = opened()
    assert [x[0] for x in run_forked(calls)] == [0, 1, 2, 3]
    assert opened() == before
    with pytest.raises(MemoryError):
        list(run_forked([Large, *calls]))
    assert opened() == before


def test_a_python_without_files_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those built against an old C library lack them."""
    monkeypatch.delattr(os, "memfd_create", raising=False)
    found = list(run_forked([partial(np.full, 1000, k) for k in range(4)]))
    assert [x.sum() for x in found] == [0, 1000, 2000, 3000]


def test_what_a_process_does_not_finish_is_done_here(tmp_path: Path) -> None:
    def killed(once: Path) -> str:
        if not once.exists():
            once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return "done"

    if usable_cores() > 1:
        assert list(run_forked([partial(killed, tmp_path / name) for name in "abc"])) == ["done"] * 3

    def fails() -> str:
        raise ValueError("no such thing")

    calls: list[Callable[[], str]] = [lambda: "fine", fails, fails]
    with pytest.raises(ValueError, match="no such thing"):
        list(run_forked(calls))
    answers = run_forked(calls)
    assert next(answers) == "fine"  # whose turn has not come fails nobody
    answers.close()


@pytest.mark.parametrize("granted", [[], [1, 4]], ids=["none", "some"])
def test_what_no_process_can_be_had_for_is_done_here(granted: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing() -> int:
        asked.append(len(asked))
        if asked[-1] not in granted:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        return fork()

    fork = os.fork
    asked: list[int] = []
    monkeypatch.setattr(os, "fork", refusing)
    assert list(run_forked([partial(int, k) for k in range(7)])) == list(range(7))
    assert len(asked) == (7 if usable_cores() > 1 else 0)


def test_nothing_is_left_running_behind_an_interrupt(tmp_path: Path) -> None:
    def waits(name: str) -> None:
        (tmp_path / name).write_text(f"{os.getpid()}\n")
        signal.pause()

    answers = run_forked([lambda: None, partial(waits, "second"), partial(waits, "third")])
    next(answers)
    begun = _pids(tmp_path, min(usable_cores(), 3) - 1)
    answers.close()
    for pid in begun:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


# The first call's answer is taken, the two others' are more than a pipe holds and never read.
STALLED = """
import os, pathlib, signal
from functools import partial
from excite.diagnosis import parallel

def large(name):
    (pathlib.Path({folder!r}) / name).write_text(f"{{os.getpid()}}\\n")
    return bytes(10_000_000)

parallel.usable_cores = lambda: 3
{also}
answers = parallel.run_forked([int, partial(large, "second"), partial(large, "third")])
next(answers)
signal.pause()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")
@pytest.mark.parametrize("also", ["", "parallel._end_with_parent = lambda parent: None"], ids=["signal", "pipe"])
def test_nothing_is_left_running_behind_a_parent_that_is_killed(tmp_path: Path, also: str) -> None:
    script = STALLED.format(folder=str(tmp_path), also=also)
    with subprocess.Popen([sys.executable, "-c", script], cwd=Path(__file__).parents[2]) as parent:
        try:
            begun = _pids(tmp_path, 2)
        finally:
            parent.kill()
    _until(lambda: not any(_runs(pid) for pid in begun), f"one of {begun} still runs")


def _pids(folder: Path, count: int) -> list[int]:
    """What the files of a folder hold, once that many are written."""

    def told() -> list[str]:
        return [text for path in folder.iterdir() if (text := path.read_text()).endswith("\n")]

    _until(lambda: len(told()) >= count, f"fewer than {count} processes began")
    assert len(told()) == count
    return [int(text) for text in told()]


def _until(holds: Callable[[], bool], otherwise: str, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, otherwise
        time.sleep(0.01)


def _runs(pid: int) -> bool:
    """Whether a process is there and not merely waiting for somebody to ask how it ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False
