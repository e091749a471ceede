"""Drives of an arm that show its payload: each is driven twice, without the payload and with it.

A payload adds its ten inertial parameters to those of the last body, so the base parameters change by G p, linear in
them. The difference of two estimates gives p by generalised least squares (`identification.payload_parameters`). A
design minimises the variances of K dX, where K is the gain of least squares along usual motions; the summary has those
of the drive itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from excite import identification, trajectories
from excite.errors import MachineError
from excite.model import Model
from excite.model.mechanics import INERTIAL
from excite.simulation import Motion, motion_along

PAYLOAD_SIZE_M = 0.1  # edge of the cube that a payload is taken for: its parameters' sizes, errors are relative to them
USUAL_SAMPLES = 400  # random samples of a usual motion


@dataclass(frozen=True)
class PayloadDesign:
    """A payload on the last body of an arm.

    names (m,): its identifiable parameters; size (m,) [SI]: what their errors are relative to. change (n_base, m):
    of the base parameters by each. value (n_base,): change by the whole payload. rigid: base parameters that friction
    and sensors leave alone, in which no more than the payload differs between both drives.
    """

    names: tuple[str, ...]
    size: np.ndarray
    change: np.ndarray
    value: np.ndarray
    rigid: tuple[int, ...]

    def covariance(self, both: np.ndarray) -> np.ndarray:
        """Return the covariance (m, m) of the payload for that of the base parameters' difference (n_base, n_base)."""
        rows, root = self._whitened(both)
        return np.asarray(np.linalg.inv(self._normal(rows, root)))

    def gain(self, both: np.ndarray) -> np.ndarray:
        """Return K (m, n_base) of generalised least squares, p = K dX, for the same covariance."""
        rows, root = self._whitened(both)
        K = np.zeros((len(self.names), len(both)))
        white = np.linalg.solve(root, self.change[rows])
        K[:, rows] = np.linalg.solve(self._normal(rows, root), np.linalg.solve(root.T, white).T)
        return K

    def _whitened(self, both: np.ndarray) -> tuple[list[int], np.ndarray]:
        """Return the rigid base parameters, and the Cholesky root of their covariance."""
        rows = list(self.rigid)
        return rows, np.linalg.cholesky(both[np.ix_(rows, rows)])

    def _normal(self, rows: list[int], root: np.ndarray) -> np.ndarray:
        white = np.linalg.solve(root, self.change[rows])
        return np.asarray(white.T @ white)


def payload_design(model: Model, mass: float) -> PayloadDesign:
    """Return a payload [kg] with its centre at the tool's point, or at the origin of the last body without one there.

    Raises MachineError for a machine that is no arm, or whose last body has no full inertia.
    """
    machine, body = model.machine, model.machine.body[-1]
    if not model.follows_positions or body.inertia is None or body.inertia.axisymmetric:
        raise MachineError(
            f"{machine.name}: --payload is for arms, whose last body has a full inertia that a payload adds to"
        )
    tool = machine.tool
    c = np.array(tool.point, float) if tool is not None and tool.body == body.index else np.zeros(3)
    J = mass * (PAYLOAD_SIZE_M**2 / 6 * np.eye(3) + c @ c * np.eye(3) - np.outer(c, c))
    p = np.array([mass, *(mass * c), J[0, 0], J[0, 1], J[0, 2], J[1, 1], J[1, 2], J[2, 2]])
    long = max(float(np.linalg.norm(c)), PAYLOAD_SIZE_M)
    size = mass * np.array([1.0, *[long] * 3, *[long**2] * 6])
    G = identification.payload_change(model)
    kept, _ = identification.told_apart(G)
    rigid = identification.rigid_parameters(model)
    return PayloadDesign(tuple(INERTIAL[k] for k in kept), size[kept], G[:, kept], G @ p, rigid)


def loaded_machines(model: Model, mass: float | None) -> tuple[Model, ...]:
    """Return the machine without and with a payload [kg], whose limits a drive keeps; none without a payload."""
    if mass is None:
        return ()
    return model, replace(model, nominal=model.nominal + payload_design(model, mass).value)


def payload_contrasts(model: Model, mass: float) -> np.ndarray:
    """Return the combinations (n_base, m) of relative errors of one drive whose variances are those of a payload."""
    found = payload_design(model, mass)
    q = trajectories.random_poses(model, USUAL_SAMPLES)
    nu, a = np.random.default_rng(0).normal(size=(2, *q.shape))
    W = model.stacked_regressor(q.T, nu.T, a.T) / trajectories.row_noise(model)[:, None] * model.scale
    information = np.einsum("nri,nrj->ij", W, W)
    C = np.linalg.pinv(information, hermitian=True) * np.outer(model.scale, model.scale)
    K = found.gain(2 * C + 1e-12 * np.diag(model.scale**2))
    return np.asarray(np.sqrt(2) * (K / found.size[:, None] * trajectories.reference_values(model)).T)


def payload_summary(model: Model, mass: float, motions: Sequence[Motion]) -> dict[str, Any]:
    """Summarise how well drives show a payload [kg], each driven without it and with it."""
    found = payload_design(model, mass)
    loaded = loaded_machines(model, mass)[1]
    each = []
    for m in (model, loaded):
        information = np.zeros((len(m.scale), len(m.scale)))
        by = np.outer(m.scale, m.scale)
        for motion in motions:
            along = motion_along(m, motion.t, motion.q, motion.nu, motion.a)
            information += np.linalg.inv(trajectories.motion_bound(m, along) / by)
        each.append(np.linalg.inv(information) * by)
    std = np.sqrt(np.diag(found.covariance(each[0] + each[1])))
    body = model.machine.body[-1]
    return {
        "mass_kg": mass,
        "body": body.name,
        "size": dict(zip(found.names, found.size.tolist(), strict=True)),
        "std": dict(zip(found.names, std.tolist(), strict=True)),
        "std_percent": dict(zip(found.names, (100 * std / found.size).tolist(), strict=True)),
    }
