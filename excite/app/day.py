"""The test day in a folder: machine, logs and results, what each step needs, and the command that does it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from excite import output, workflows
from excite.app.job import Job
from excite.app.results import Result, is_readable_file, read_result, read_stored
from excite.errors import MachineError
from excite.logs import SUFFIXES
from excite.model.machine import MACHINES, Machine, is_machine_file, load_machine, machine_files, shipped_machines
from excite.text import format_number

MOST_PASSED_OVER = 20  # lines about what no step can show
STATE = "app.json"  # choices of the day that no result holds
STEPS = {
    "machine": "Machine",
    "design": "Design",
    "drive": "Drive",
    "log": "Log",
    "identify": "Identify",
    "diagnose": "Diagnose",
}
PROFILE_FILES = ("profile.csv", "phases.csv", "covariance.csv", "prediction.csv")  # tables that are no logs


@dataclass(frozen=True)
class Need:
    """Something that a step needs, and whether it is there."""

    met: bool
    text: str


@dataclass(frozen=True)
class NumberField:
    """Rules of a number field: label, least value, whether the number is whole, whether there must be one."""

    label: str
    low: float
    whole: bool = False
    needed: bool = False

    def fault(self, value: Any) -> str:
        """Return what is wrong with a value, "" for nothing."""
        if value in (None, ""):
            return "a number is needed" if self.needed else ""
        if value < self.low:
            return f"must be {self.low:g} or more (got {value:g})"
        return f"must be a whole number (got {value:g})" if self.whole and value != int(value) else ""


NUMBERS = {  # fields of numbers by step
    "design": {
        "duration": NumberField("Length of the drive [s]", 1),
        "starts": NumberField("Starting guesses", 1, whole=True, needed=True),
        "budget": NumberField("Time for the search [s]", 1),
        "sigma_max": NumberField("Largest standard deviation allowed [%]", 0.001),
        "seed": NumberField("Seed", 0, whole=True, needed=True),
    },
    "drive": {"phases": NumberField("Most phases", 2, whole=True), "shortest": NumberField("Shortest phase [s]", 0.5)},
    "log": {"seed": NumberField("Seed", 0, whole=True, needed=True)},
    "diagnose": {"budget": NumberField("Time for the search [s]", 1)},
}


class Day:
    """The state that every browser shares: choices, forms, the running job, and results as the folder has them.

    forms: by step, what its fields hold. accepted: words that accept doubts about a log, and these doubts.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.machine: str | None = None
        self.logs: list[str] = []
        self.accepted: dict[str, Any] = {"words": "", "doubts": []}
        self.forms: dict[str, dict[str, Any]] = {
            "machine": {"new": "", "like": "", "path": ""},
            "design": {
                "problem": None,
                "duration": None,
                "objective": "cond",
                "starts": 2,
                "budget": None,
                "driver": False,
                "robust": False,
                "sigma_max": None,
                "seed": 0,
                "out": "",
            },
            "drive": {"design": None, "phases": None, "shortest": None, "out": ""},
            "log": {"path": "", "effect": "", "seed": 0},
            "identify": {"method": None, "words": "", "out": ""},
            "diagnose": {"budget": None, "next": False, "out": ""},
            "compare": {"left": None, "right": None},
        }
        self.job: Job | None = None
        self._seen: list[Result] | None = None
        self._read: dict[Path, tuple[int, Result | str | None]] = {}
        self.passed_over: list[str] = []  # what the folder holds and no step can show, a line each
        self._loaded: dict[str, tuple[tuple[int, ...], list[Path], Machine | MachineError]] = {}
        self._fresh: set[str] = set()  # machines whose files were looked at in this glance
        self._restore()

    # -------------------------------------------------------------------------------------------- what is stored

    def _restore(self) -> None:
        """Take up the choices of before; without any, those of the newest results."""
        said = read_stored(self.folder / STATE)
        for name, form in self.forms.items():
            kept = said.forms.get(name, {})
            form.update({key: kept[key] for key in form if key in kept and _alike(form[key], kept[key])})
        if {"words", "doubts"} <= set(said.accepted):
            self.accepted = dict(said.accepted)
        self.logs = [path for path in said.logs if is_readable_file(path)]
        self.machine = said.machine if said.machine in self.machines() else self._machine_of_results()
        if not self.logs:
            self.logs = self._logs_of_results()

    def save(self) -> None:
        """Store the choices of the day."""
        self.folder.mkdir(parents=True, exist_ok=True)
        said = {"machine": self.machine, "logs": self.logs, "accepted": self.accepted, "forms": self.forms}
        with output.new_file(self.folder / STATE) as place:
            place.write_text(output.to_json(said), encoding="utf-8")

    def _machine_of_results(self) -> str | None:
        names = {self.machine_name(m): m for m in reversed(self.machines())}
        return next((names[n] for r in self.results() if (n := r.summary.get("machine")) in names), None)

    def _logs_of_results(self) -> list[str]:
        for result in self.results("log", "identify", "diagnose"):
            used = [result.summary["log"]] if result.kind == "log" else result.summary["logs"]
            used = list(dict.fromkeys(str(path).partition(" from row ")[0] for path in used))
            if self._is_machine(result.summary.get("machine")) and all(map(is_readable_file, used)):
                return used
        return []

    def results(self, *kinds: str) -> list[Result]:
        """Return the results in the folder, of some kinds or of all, the newest first."""
        every = self._scan() if self._seen is None else self._seen
        return [r for r in every if not kinds or r.kind in kinds]

    @contextmanager
    def glance(self) -> Iterator[None]:
        """Look at the folder once for everything in the block."""
        self._seen = self._scan()
        try:
            yield
        finally:
            self._seen = None
            self._fresh.clear()

    def _scan(self) -> list[Result]:
        found, odd = [], list[str]()
        for path in (*self.folder.glob(f"*/{output.SUMMARY}"), *self.folder.glob(f"*/*/{output.SUMMARY}")):
            if not path.parent.name.startswith(".") and not path.parents[1].name.startswith("."):
                result = self._result(path)
                if isinstance(result, Result):
                    found.append(result)
                elif result is not None:
                    odd.append(result)
        for path in sorted(self.folder.glob("*")):
            if path.suffix.lower() in (*SUFFIXES, ".toml") and not path.is_file():
                odd.append(f"{path}: is no file")
        self.passed_over = sorted(odd)[:MOST_PASSED_OVER]
        return sorted(found, key=lambda r: (-r.time, str(r.folder)))

    def _result(self, path: Path) -> Result | str | None:
        try:
            stamp = path.stat().st_mtime_ns
        except OSError as err:
            return f"{path}: can't be read: {err.strerror}"
        if self._read.get(path, (None,))[0] != stamp:
            self._read[path] = (stamp, read_result(path.parent, stamp / 1e9))
        return self._read[path][1]

    # -------------------------------------------------------------------------------------------- machine and logs

    def machines(self) -> list[str]:
        """Return the machines to choose from: files in the folder and the current one, then the shipped ones."""
        here = Path()
        files = [*sorted(self.folder.glob("*.toml")), *(sorted(here.glob("*.toml")) if self.folder != here else ())]
        chosen = [self.machine] if self.machine and self.machine.endswith(".toml") else []
        own = [str(f) for f in files if is_machine_file(f)]
        return list(dict.fromkeys([*own, *chosen, *shipped_machines()]))

    def load(self) -> Machine | None:
        """Return the chosen machine; None if there is none or its file is wrong."""
        found = self._load(self.machine) if self.machine else None
        return found if isinstance(found, Machine) else None

    def machine_error(self) -> str:
        """Return what is wrong with the chosen machine's file, "" for nothing."""
        found = self._load(self.machine) if self.machine else None
        return str(found) if isinstance(found, MachineError) else ""

    def machine_name(self, machine: str) -> str:
        """Return the name of a machine, "" if its file is wrong."""
        if machine in shipped_machines():
            return machine
        found = self._load(machine)
        return found.name if isinstance(found, Machine) else ""

    def machine_path(self) -> Path:
        """Return the file of the chosen machine."""
        assert self.machine is not None
        return MACHINES / f"{self.machine}.toml" if self.machine in shipped_machines() else Path(self.machine)

    def _load(self, machine: str) -> Machine | MachineError:
        if machine in self._fresh:
            return self._loaded[machine][2]
        files: list[Path]
        try:
            files = machine_files(machine)
            stamps = tuple(f.stat().st_mtime_ns for f in files)
        except (MachineError, OSError):
            files, stamps = [], (-1,)
        if machine not in self._loaded or self._loaded[machine][0] != stamps or stamps == (-1,):
            found: Machine | MachineError
            try:
                found = load_machine(machine)
            except MachineError as err:
                found = err
            self._loaded[machine] = (stamps, files, found)
        if self._seen is not None:
            self._fresh.add(machine)
        return self._loaded[machine][2]

    def _is_machine(self, name: object) -> bool:
        return self.machine is not None and name == self.machine_name(self.machine)

    def known_logs(self) -> list[str]:
        """Return the logs to choose from: those in the folder, checked before, or chosen."""
        there = [str(p) for p in sorted(self.folder.glob("*")) if p.suffix.lower() in SUFFIXES and p.is_file()]
        checked = [r.summary["log"] for r in self.results("log") if is_readable_file(r.summary["log"])]
        return sorted(path for path in {*self.logs, *there, *checked} if Path(path).name not in PROFILE_FILES)

    # -------------------------------------------------------------------------------------------- results that count

    def designs(self) -> list[Result]:
        """Return the designs of the chosen machine, the newest first."""
        return [r for r in self.results("design") if self._is_machine(r.summary["machine"])]

    def design_names(self) -> dict[str, str]:
        """Return the designs of the chosen machine by folder, each with its worst parameter and cond(Phi)."""
        names = {}
        for r in self.designs():
            worst, cond = r.summary["worst_percent"], r.summary.get("cond_phi")
            known = worst is not None and isinstance(cond, int | float)
            said = f": worst {format_number(worst, 3)} % at cond(Phi) {format_number(cond, 4)}" if known else ""
            names[str(r.folder)] = f"{r.folder.relative_to(self.folder)}{said}"
        return names

    def design(self) -> Result | None:
        """Return the design to drive: the chosen one, or the newest."""
        found = self.designs()
        chosen = self.forms["drive"]["design"]
        return next((r for r in found if str(r.folder) == chosen), found[0] if found else None)

    def check_of(self, log: str) -> Result | None:
        """Return the newest check of a log for the chosen machine."""
        same = (r for r in self.results("log") if _same(r.summary["log"], log))
        return next((r for r in same if self._is_machine(r.summary["machine"])), None)

    def result_of(self, step: str) -> Result | None:
        """Return the result that a step shows; of the log step, a failed check if there is one."""
        if self.machine is None:
            return None
        if step == "machine":
            file = self.machine_path()
            return next((r for r in self.results("machine") if _same(r.summary["file"], file)), None)
        if step == "design":
            return self.design()
        if step == "log":
            checks = [check for log in self.logs if (check := self.check_of(log))]
            faulty = [check for check in checks if check.summary["faults"] or self.outdated(check)]
            return next(iter([*faulty, *checks]), None) if len(checks) == len(self.logs) else None
        for r in self.results(step):
            if step == "drive" and (design := self.design()) and _same(r.summary["design"], design.folder):
                return r
            if step in ("identify", "diagnose") and self._is_machine(r.summary["machine"]):
                used = {output.real(log.partition(" from row ")[0]) for log in r.summary["logs"]}
                if used == {output.real(log) for log in self.logs}:
                    return r
        return None

    def outdated(self, result: Result) -> str:
        """Return what changed after a result was made, "" for nothing."""
        sources: Iterable[Path] = ()
        if result.kind == "drive":
            sources = [Path(result.summary["design"]) / output.SUMMARY]
        elif result.kind == "log":
            sources = [Path(result.summary["log"])]
        elif result.kind in ("identify", "diagnose"):
            sources = [Path(log.partition(" from row ")[0]) for log in result.summary["logs"]]
        own = self._loaded[self.machine][1] if self.machine and result.kind != "drive" and self.load() else ()
        for path in (*sources, *own):
            if path.exists() and path.stat().st_mtime > result.time:
                return f"{path} has changed since"
        return ""

    def doubts(self) -> list[str]:
        """Return the doubts of the checks of the chosen logs."""
        checks = (self.check_of(log) for log in self.logs)
        return [line for check in checks if check for line in check.summary["doubts"]]

    def accepted_words(self) -> str:
        """Return the words that accept the present doubts, "" if there are none or they are others."""
        doubts = self.doubts()
        return str(self.accepted["words"]).strip() if doubts and self.accepted["doubts"] == doubts else ""

    # -------------------------------------------------------------------------------------------- what a step needs

    def needs(self, step: str) -> list[Need]:
        """Return what a step needs, in the order in which to provide it."""
        if self.machine is None:
            return [Need(False, "a machine: choose one in step Machine")]
        if step == "machine":
            return [Need(True, f"a machine: {self.machine}")]
        if self.load() is None:
            return [Need(False, f"a machine file without errors: {self.machine_error()}")]
        machine = Need(True, f"a machine: {self.machine}")
        if step == "design":
            return [machine, self._checked_machine()]
        if step == "drive":
            design = self.design()
            return [Need(True, f"a design: {design.folder}") if design else Need(False, "a design: step Design")]
        if step == "log":
            return [machine, Need(bool(self.logs), f"a log: {', '.join(self.logs) or 'choose one below'}")]
        if not self.logs:
            return [machine, Need(False, "a log that passes its check: step Log")]
        return [machine, *(self._passed(log) for log in self.logs), *self._acceptance()]

    def _checked_machine(self) -> Need:
        check = self.result_of("machine")
        if check is None:
            return Need(False, "a machine that passes its check: step Machine")
        if changed := self.outdated(check):
            return Need(False, f"the machine checked again: {changed}")
        faults = check.summary["faults"]
        return Need(not faults, f"a machine that passes its check{': mend what step Machine says' if faults else ''}")

    def _passed(self, log: str) -> Need:
        check = self.check_of(log)
        if check is None:
            return Need(False, f"{log} checked: step Log")
        changed, faults = self.outdated(check), check.summary["faults"]
        if changed:
            return Need(False, f"{log} checked again: {changed}")
        if faults:
            return Need(False, f"{log} to pass its check: mend it first, then check it again. {faults[0]}")
        return Need(True, f"{log}, which passes its check")

    def _acceptance(self) -> list[Need]:
        doubts, words = self.doubts(), self.accepted_words()
        if not doubts:
            return []
        if words:
            return [Need(True, f'doubts about the log accepted: "{words}"')]
        return [Need(False, "an answer to the doubts of its check: mend the log, or accept them in step Identify")]

    def wrong_numbers(self, step: str) -> list[str]:
        """Return what is wrong with the numbers in the fields of a step, by their labels."""
        form, numbers = self.forms.get(step, {}), NUMBERS.get(step, {})
        return [f"{one.label}: {said}" for key, one in numbers.items() if (said := one.fault(form[key]))]

    def ready(self, step: str) -> bool:
        """Return True if a step has what it needs, its fields too, and nothing runs."""
        wrong = step != "log" and self.wrong_numbers(step)  # whose only number is of simulations
        return all(need.met for need in self.needs(step)) and not wrong and not self.running

    def state(self, step: str) -> str:
        """Return where a step stands: running, failed, to do again, doubtful, done, ready or waiting."""
        if self.running and self.job and self.job.step == step:
            return "running"
        result = self.result_of(step)
        if result is not None:
            bad = result.summary.get("faults") or result.summary.get("status") == "invalid"
            if bad or self.outdated(result):
                return "failed" if bad else "to do again"
            return "doubtful" if self._in_doubt(step, result) else "done"
        return "ready" if all(need.met for need in self.needs(step)) else "waiting"

    def _in_doubt(self, step: str, result: Result) -> bool:
        """Return True for a step that ended in doubts which nobody accepted."""
        if step == "log":
            return bool(self.doubts()) and not self.accepted_words()
        return bool(result.summary.get("doubts")) or result.summary.get("status") == "doubtful"

    # -------------------------------------------------------------------------------------------- commands

    @property
    def running(self) -> bool:
        """True while a command runs."""
        return self.job is not None and self.job.running

    def out(self, step: str) -> Path:
        """Return the folder that a step writes."""
        assert self.machine is not None
        given = str(self.forms[step].get("out") or "").strip()
        if given:
            return self.folder / Path(given.replace("\0", "")).name[: output.MAX_NAME]
        plain = self.folder / f"{step}-{workflows.machine_stem(self.machine)}"
        if step != "design":
            return plain
        free = (self.folder / f"{plain.name}{'' if k == 1 else f'-{k}'}" for k in range(1, 1000))
        return next(path for path in free if not path.exists())

    def command(self, step: str, log: str = "") -> list[str]:
        """Return the arguments of a step's command. log: of the log step, the log to check."""
        assert self.machine is not None
        if step == "log":
            place = output.folder_of_check(self.folder, Path(log))
            return ["log", "check", log, "--machine", self.machine, "--out", str(place)]
        form, out = self.forms[step], ["--out", str(self.out(step))]
        if step == "machine":
            return ["machine", "check", str(self.machine_path()), *out]
        if step == "design":
            asked = ("problem", "duration", "objective", "starts", "budget", "sigma_max", "seed")
            return ["design", self.machine, *_options(form, asked), *_flags(form, "driver", "robust"), *out]
        if step == "drive":
            design = self.design()
            return ["drive", str(design.folder if design else ""), *_options(form, ("phases", "shortest")), *out]
        words = self.accepted_words()
        accept = ["--accept", words] if words else []
        options = ("method",) if step == "identify" else ("budget",)
        return [*(step, self.machine, *self.logs, *_options(form, options), *_flags(form, "next")), *(*accept, *out)]

    def start(self, step: str, arguments: list[str] | None = None, then: Callable[[Job], None] | None = None) -> None:
        """Run a step's command, or another for it. then: called after it has ended. Does nothing while one runs."""
        if self.running:
            return
        self.save()
        arguments = arguments or self.command(step)
        out = Path(arguments[arguments.index("--out") + 1])

        def ended(job: Job) -> None:
            if step == "design" and job.code == 0:
                self.forms["drive"]["design"] = str(out)
                self.forms["design"]["out"] = ""
            if then is not None:
                then(job)
            self.save()

        self.job = Job(step, arguments, out, ended)

    def choose(self, machine: str) -> None:
        """Choose a machine; the fields that depend on it begin anew."""
        if machine != self.machine:
            self.machine = machine
            self.forms["design"] |= {"problem": None, "duration": None, "out": ""}
            self.forms["drive"]["design"] = None
            self.save()


def _options(form: dict[str, Any], names: Iterable[str]) -> list[str]:
    """Return the options of fields that are filled in."""
    found = []
    for name in names:
        value = form[name]
        if value not in (None, ""):
            text = str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)
            found += [f"--{name.replace('_', '-')}", text]
    return found


def _flags(form: dict[str, Any], *names: str) -> list[str]:
    return [f"--{name}" for name in names if form.get(name)]


def _alike(usual: Any, kept: Any) -> bool:
    """True if a field may hold what was kept: a value of its usual type, or nothing."""
    number = isinstance(kept, int | float) and not isinstance(kept, bool)
    if usual is None:
        return kept is None or number or isinstance(kept, str)
    return number if isinstance(usual, int) and not isinstance(usual, bool) else isinstance(kept, type(usual))


def _same(one: str | Path, other: str | Path) -> bool:
    return output.real(one) == output.real(other)
