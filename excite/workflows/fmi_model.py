"""An arm with its identified parameters as an FMI 3.0 model: torques in, positions, speeds and accelerations out.

The forward dynamics are C code that CasADi writes, compiled here with the machine's C compiler.

Source: Modelica Association, "Functional Mock-up Interface Specification", version 3.0.
"""

from __future__ import annotations

import hashlib
import io
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from xml.etree import ElementTree

import casadi as ca
import numpy as np

from excite.errors import MachineError, UsageError
from excite.model import Model, build, standard_parameters
from excite.model.machine import Machine
from excite.workflows import model_files

COMPILERS = ("cc", "gcc", "clang")
PROCESSORS = {"x86_64": "x86_64", "AMD64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}
SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib")}


def fmi_model(machine: Machine, p: Mapping[str, float]) -> tuple[bytes, list[str]]:
    """Return an FMU for model exchange with standard parameters p [SI], and notes.

    Dry friction turns as the machine file smooths it. Raises MachineError, UsageError without a C compiler.
    """
    model_files.check_tree(machine)
    model = build(machine)
    if not model.plain:
        raise MachineError(f"{machine.name}: can't be written as a model: it has effects, take them out")
    name = machine.name.replace("-", "_")
    source = _source(model, p)
    token = hashlib.sha256(source.encode()).hexdigest()[:32]
    source = f'#define TOKEN "{token}"\n{source}'
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", _description(model, name, token))
        archive.writestr(f"binaries/{_platform()[0]}/{name}{_platform()[1]}", _compiled(source))
        archive.writestr("sources/model.c", source)
        archive.writestr("sources/buildDescription.xml", _build_description(name))
    return made.getvalue(), model_files.notes(machine, {})


def _source(model: Model, p: Mapping[str, float]) -> str:
    """Return the C code of the accelerations and of the functions of FMI around them."""
    n_q, n_u = len(model.coordinates), len(model.inputs)
    q, nu, a = model.symbols()
    u = ca.SX.sym("u", n_u)
    values = ca.DM([0.0 if n.startswith("u") else p[n] for n in standard_parameters(model.machine)])
    force = model.predict(q, nu, a, values)
    M = ca.jacobian(force, a)
    rest = ca.substitute(force, a, ca.SX.zeros(n_q))
    acceleration = ca.solve(M, ca.DM(model.machine.input_matrix) @ u - rest)
    f = ca.Function("excite_acceleration", [q, nu, u], [acceleration], {"cse": True})
    generator = ca.CodeGenerator("excite_model", {"verbose": False})
    generator.add(f)
    sizes = {"N_Q": n_q, "N_U": n_u, "SZ_ARG": f.sz_arg(), "SZ_RES": f.sz_res(), "SZ_IW": f.sz_iw(), "SZ_W": f.sz_w()}
    low, high = np.array([_range(model, k) for k in range(n_q)]).T
    start = np.concatenate([np.where((low <= 0) & (high >= 0), 0.0, (low + high) / 2), np.zeros(n_q)])
    sizes |= {"START": "{" + ", ".join(f"{x:.17g}" for x in start) + "}"}
    template = (files("excite") / "templates" / "fmi_model.c").read_text(encoding="utf-8")
    return "".join([*(f"#define {key} {value}\n" for key, value in sizes.items()), generator.dump(), "\n", template])


def _range(model: Model, k: int) -> tuple[float, float]:
    """Return the range of a coordinate, half a turn either way without a limit."""
    (body,) = (b for b in model.machine.body if model.coordinates[k] in b.coordinates)
    return body.limit.position_range or (-np.pi, np.pi)


def _platform() -> tuple[str, str]:
    """Return the platform's name in FMI 3.0 and the suffix of its libraries. Raises UsageError."""
    system, processor = SYSTEMS.get(sys.platform), PROCESSORS.get(platform.machine())
    if system is None or processor is None:
        raise UsageError(f"an FMU can't be compiled on {sys.platform} {platform.machine()}, only on Linux and macOS")
    return f"{processor}-{system[0]}", system[1]


def _compiled(source: str) -> bytes:
    """Compile C code as a shared library. Raises UsageError without a compiler that does."""
    compiler = next((found for name in COMPILERS if (found := shutil.which(name))), None)
    if compiler is None:
        raise UsageError("an FMU needs a C compiler: none of " + ", ".join(COMPILERS) + " is installed")
    with tempfile.TemporaryDirectory() as place:
        code, library = Path(place, "model.c"), Path(place, "model.so")
        code.write_text(source, encoding="utf-8")
        command = [compiler, "-O1", "-shared", "-fPIC", "-w", str(code), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise UsageError(f"{compiler} can't compile the model: {done.stderr.splitlines()[0]}")
        return library.read_bytes()


def _description(model: Model, name: str, token: str) -> str:
    """Return modelDescription.xml: variables in the order of their value references."""
    root = ElementTree.Element(
        "fmiModelDescription", fmiVersion="3.0", modelName=model.machine.title, instantiationToken=token
    )
    ElementTree.SubElement(root, "ModelExchange", modelIdentifier=name)
    variables = ElementTree.SubElement(root, "ModelVariables")
    structure = ElementTree.SubElement(root, "ModelStructure")
    n_u, n_q = len(model.inputs), len(model.coordinates)

    def add(reference: int, name: str, causality: str, **more: str) -> None:
        kept = {"name": name, "valueReference": str(reference), "causality": causality, "variability": "continuous"}
        ElementTree.SubElement(variables, "Float64", kept | more)

    add(0, "time", "independent")
    for k, u in enumerate(model.inputs):
        add(1 + k, u, "input", start="0")
    states = [*model.coordinates, *(f"d{c}" for c in model.coordinates)]
    rates = [*(f"der({c})" for c in model.coordinates), *(f"dd{c}" for c in model.coordinates)]
    low, high = np.array([_range(model, k) for k in range(n_q)]).T
    start = [*np.where((low <= 0) & (high >= 0), 0.0, (low + high) / 2), *np.zeros(n_q)]
    first = 1 + n_u
    for k, c in enumerate(states):
        add(first + k, c, "output", initial="exact", start=f"{start[k]:.17g}")
    for k, c in enumerate(rates):
        add(first + 2 * n_q + k, c, "local" if k < n_q else "output", initial="calculated", derivative=str(first + k))
    outputs = [*range(first, first + 2 * n_q), *range(first + 3 * n_q, first + 4 * n_q)]
    derivatives = list(range(first + 2 * n_q, first + 4 * n_q))
    for kind, references in (
        ("Output", outputs),
        ("ContinuousStateDerivative", derivatives),
        ("InitialUnknown", derivatives),
    ):
        for reference in references:
            ElementTree.SubElement(structure, kind, valueReference=str(reference))
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _build_description(name: str) -> str:
    """Return buildDescription.xml, by which other platforms compile the source."""
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    build_configuration = ElementTree.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    sources = ElementTree.SubElement(build_configuration, "SourceFileSet", language="C99")
    ElementTree.SubElement(sources, "SourceFile", name="model.c")
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


# Writers of a machine with standard parameters by the suffix of the file; each returns its content, and notes.
MODEL_WRITERS: dict[str, Callable[[Machine, Mapping[str, float]], tuple[str | bytes, list[str]]]] = {
    ".urdf": model_files.urdf_model,
    ".xml": model_files.mjcf_model,
    ".fmu": fmi_model,
}
