"""Records for files: quantities with their source, strict about unknown keys, and one-line error messages."""

from __future__ import annotations

import math
import re
import reprlib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from excite.text import did_you_mean

MOST_BYTES = 5_000_000  # of a TOML file; those of machines have 20 kB; chosen
MOST_ENTRIES = 50_000  # keys and elements of lists in it; chosen
LONGEST_KEY, LONGEST_TEXT = 200, 10_000  # characters; chosen
MOST_BITS = 14_000  # of an integer: what Python prints has 4300 digits at most
MOST_SAID = 100  # faults of a file that are listed; chosen

Source = Literal["paper", "data sheet", "measured", "published", "identified", "assumed", "definition"]


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file, with or without byte-order mark. Raises ValueError, one line."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"more than {MOST_BYTES // 10**6} MB")
        text = path.read_text(encoding="utf-8-sig")
        pieces = (p for line in text.splitlines() for p in line.partition("#")[0].split("=")[:-1] or [line])
        dots = [re.split("[,{]", piece)[-1].count(".") for piece in pieces]  # of keys a.b.c, which tomllib is slow at
        if dots and (max(dots) > LONGEST_KEY or sum(dots) > MOST_ENTRIES):
            raise ValueError("tables are nested too deeply")
        found = tomllib.loads(text)
        if _entries(found) > MOST_ENTRIES:
            raise ValueError(f"holds more than {MOST_ENTRIES} keys")
        return found
    except UnicodeDecodeError as err:
        line = err.object.count(b"\n", 0, err.start) + 1
        raise ValueError(f"{path}: not a TOML file: line {line} is not UTF-8; save it as UTF-8") from None
    except RecursionError:
        raise ValueError(f"{path}: not a TOML file: lists or tables are nested too deeply") from None
    except ValueError as err:
        fault = "holds an integer of thousands of digits" if "integer string conversion" in str(err) else err
        raise ValueError(f"{path}: not a TOML file: {fault}") from None
    except OSError as err:
        raise ValueError(f"{path}: can't be read: {err.strerror}") from None


def _entries(value: Any) -> int:
    """Count the keys and elements of nested tables and lists. Raises ValueError for a value of absurd length."""
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        raise ValueError(f"holds an integer of {value.bit_length()} bits")
    if isinstance(value, str) and len(value) > LONGEST_TEXT:
        raise ValueError(f"{value[:20]!r}... is a text of {len(value)} characters, at most {LONGEST_TEXT}")
    if isinstance(value, dict):
        long = next((key for key in value if len(key) > LONGEST_KEY), None)
        if long is not None:
            raise ValueError(f"{long[:20]!r}... is a key of {len(long)} characters, at most {LONGEST_KEY}")
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return len(inside) + sum(map(_entries, inside))


_PLAIN = re.compile(r"^\s*[+-]?\d+(\.\d*)?\s*$")
_PI = re.compile(r"^\s*([+-]?)\s*(?:(\d+(?:\.\d+)?)\s*\*\s*)?pi\s*(?:/\s*(\d+(?:\.\d+)?))?\s*$")


def _number(value: Any) -> Any:
    """Read a number, also in quotes, or a multiple of pi such as "-pi/2", which keeps table entries exact.

    Raises ValueError.
    """
    if isinstance(value, bool):
        raise ValueError("must be a number, not true/false")
    if isinstance(value, int) and abs(value) > 10**18:
        raise ValueError("must be 0 or of a size between 1e-12 and 1e12, in SI units")
    if isinstance(value, str):
        if _PLAIN.match(value):
            return float(value)
        match = _PI.match(value)
        if not match:
            raise ValueError('must be a number, or a multiple of pi such as "-pi/2"')
        sign, factor, divisor = match.groups()
        if divisor and float(divisor) == 0:
            raise ValueError("must be a finite number, not pi/0")
        return (-1.0 if sign == "-" else 1.0) * float(factor or 1) * math.pi / float(divisor or 1)
    return value


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"must be a finite number (got {value})")
    if value and not 1e-12 <= abs(value) <= 1e12:
        raise ValueError(f"must be 0 or of a size between 1e-12 and 1e12, in SI units (got {value:g})")
    return value


def _known(value: Any) -> Any:
    """Check `known`: true, or a standard deviation above zero. Raises ValueError."""
    if isinstance(value, bool):
        return value
    if not isinstance(value, (int, float)) or not 0 < value < 1e18:
        raise ValueError(f"must be true (known exactly) or a standard deviation > 0 (got {reprlib.repr(value)})")
    return float(value)


def _positive(q: Quantity) -> Quantity:
    if not q.value > 0:
        raise ValueError(f"must be > 0 (got {q.value:g})")
    return q


def _not_negative(q: Quantity) -> Quantity:
    if q.value < 0:
        raise ValueError(f"must be >= 0 (got {q.value:g})")
    return q


def _negative(q: Quantity) -> Quantity:
    if not q.value < 0:
        raise ValueError(f"must be < 0 (got {q.value:g}): the soil resists slip")
    return q


class FileRecord(BaseModel):
    """A frozen table of a file; unknown keys are errors, so that no misspelt key is silently ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid")


Number = Annotated[float, BeforeValidator(_number), AfterValidator(_finite)]
Flag = Annotated[bool, Field(strict=True)]


Known = Annotated[bool | float, BeforeValidator(_known)]


class Quantity(FileRecord):
    """A value [SI] and its source.

    known: true if the value is exact, or its standard deviation; identification then uses it like a measurement.
    tolerance: standard deviation [SI] of a value that identification takes as it is, such as a length: it widens the
    intervals. Without one the default of its kind holds (`Tolerances`); a value by definition is exact.
    """

    value: Number
    source: Source
    note: str = ""
    known: Known = False
    tolerance: Annotated[float | None, Field(ge=0, allow_inf_nan=False)] = None

    def tolerance_or(self, default: float) -> float:
        """Return the stated tolerance, zero for a value by definition, or the default of its kind."""
        if self.tolerance is not None:
            return self.tolerance
        return 0.0 if self.source == "definition" else default

    def __float__(self) -> float:
        return self.value


Positive = Annotated[Quantity, AfterValidator(_positive)]
NotNegative = Annotated[Quantity, AfterValidator(_not_negative)]
Negative = Annotated[Quantity, AfterValidator(_negative)]
Vector3 = tuple[Number, Number, Number]


class BodyPoint(FileRecord):
    """A point [m] in the body's frame. known: as of a `Quantity`, of each coordinate."""

    value: Vector3
    source: Source
    note: str = ""
    known: Known = False


def error_line(path: Path | str, err: ValidationError, root: type[FileRecord]) -> str:
    """Return the first error of a file that holds a `root` record: file, key, problem, what is allowed."""
    first = error_lines(path, err, root, most=1)[0]
    return f"{first} (and {err.error_count() - 1} more)" if err.error_count() > 1 else first


def error_lines(path: Path | str, err: ValidationError, root: type[FileRecord], most: int = MOST_SAID) -> list[str]:
    """Return the errors of a file that holds a `root` record, a line each, up to so many."""
    texts = [error_text(one, root) for one in err.errors(include_url=False)[:most]]
    return [" ".join(f"{path}: {key + ': ' if key else ''}{message}".split()) for key, message in texts]


def error_text(one: ErrorDetails, root: type[FileRecord]) -> tuple[str, str]:
    """Put a validation error into plain words: its key, and what is wrong with it."""
    key = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in one["loc"]).lstrip(".")
    kind, message, got = one["type"], one["msg"], one.get("input")
    if kind == "extra_forbidden":
        fields = record_at(one["loc"][:-1], root).model_fields
        message = f"no such key here, allowed: {', '.join(fields)}{did_you_mean(one['loc'][-1], fields)}"
    elif kind == "missing":
        message = "is missing"
    elif kind == "model_type":
        record = record_at(one["loc"], root)
        number = record in (Quantity, BodyPoint)
        table = '{ value = ..., source = "..." }' if number else f"with keys {', '.join(record.model_fields)}"
        message = f"must be a table {table} (got {reprlib.repr(got)})"
    elif kind == "value_error":
        message = message.removeprefix("Value error, ")
        inner, _, rest = message.partition(": ")
        if inner in record_at(one["loc"], root).model_fields:
            key, message = f"{key}.{inner}".lstrip("."), rest
    elif kind == "too_short":
        message = f"must have at least {one['ctx']['min_length']} (got {one['ctx']['actual_length']})"
    elif kind == "too_long":
        message = f"must have at most {one['ctx']['max_length']} (got {one['ctx']['actual_length']})"
    else:
        message = message.replace("Input should be", "must be").replace("String should", "must")
        message = message.replace("a valid tuple", "a list in brackets") + f" (got {reprlib.repr(got)})"
        if kind == "literal_error":
            message += did_you_mean(got, re.findall(r"'([^']*)'", one["ctx"]["expected"]))
    return key, message


def record_at(where: tuple[int | str, ...], root: type[FileRecord]) -> type[FileRecord]:
    """Return the type of the record at a key of the file."""
    record = root
    for step in where:
        field = record.model_fields.get(str(step))
        if field is not None:
            inside = _record_in(field.annotation)
            record = inside or record
    return record


def _record_in(annotation: Any) -> type[FileRecord] | None:
    """Return the type of record inside an annotation, None for none."""
    if isinstance(annotation, type) and issubclass(annotation, FileRecord):
        return annotation
    return next((r for a in get_args(annotation) if (r := _record_in(a)) is not None), None)
