"""A drive that people can follow: phases, words, sides, tolerance, room, and what a person keeps of a design."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from support.commands import Excite

from excite import trajectories
from excite.errors import UndrivableError
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.operator import Trace, driving_aids, ground, page, sheet
from excite.simulation import STEADY_DRIVER, Motion, simulate
from excite.trajectories import Manoeuvre, saved_design

RESULTS = Path(__file__).parents[2] / "results"
KNOTS = np.array([0.0, 4, 9, 12, 15, 19, 23, 27])
SPEED = np.array([0.0, 1.5, 1.5, 0, 0, -1.2, -1.2, 0])
ANGLE = np.deg2rad([[0.0], [0], [20], [20], [0], [0], [-10], [0]])


def motion_of(model: Model, speed: np.ndarray, angle: np.ndarray) -> Motion:
    """A motion with just the speed and articulation given."""
    n, n_q = len(speed), len(model.coordinates)
    still = simulate(model, np.zeros((2, len(model.inputs))))
    q, nu = np.zeros((n, n_q)), np.zeros((n, n_q))
    nu[:, 0] = speed
    if "theta2" in model.coordinates:
        q[:, model.coordinates.index("theta2")] = angle
    return replace(still, t=np.arange(n) / 100, q=q, nu=nu)


def test_phases_of_a_drive_made_of_phases_are_these(va12: Model) -> None:
    t = np.arange(2701) / 100
    motion = motion_of(va12, np.interp(t, KNOTS, SPEED), np.interp(t, KNOTS, ANGLE[:, 0]))
    trace = ground.trace_from_motion(va12, motion, most=9)
    assert trace.times == pytest.approx(KNOTS)
    assert trace.speed == pytest.approx(SPEED, abs=1e-9)
    assert trace.angle == pytest.approx(ANGLE, abs=1e-9)


@pytest.mark.parametrize(("most", "shortest"), [(4, 2.0), (12, 2.0), (20, 3.0)])
def test_phases_are_few_and_long_enough_and_within_the_machine(
    va12: Model, va12_motion: Motion, most: int, shortest: float
) -> None:
    trace = ground.trace_from_motion(va12, va12_motion, shortest, most)
    assert 2 <= len(trace) <= most
    assert np.diff(trace.times).min() >= shortest - 1e-9
    assert trace.times[-1] == va12_motion.t[-1]
    assert [trace.speed[0], trace.speed[-1], *trace.angle[0], *trace.angle[-1]] == [0, 0, 0, 0]
    assert np.abs(trace.speed).max() <= 2.0
    assert np.abs(trace.angle).max() <= 0.6
    assert np.abs(np.diff(trace.angle[:, 0]) / np.diff(trace.times)).max() <= 0.35


def test_more_phases_are_nearer_to_the_design(va12: Model, va12_motion: Motion) -> None:
    def misfit(most: int) -> float:
        speed, _ = ground.trace_from_motion(va12, va12_motion, most=most).at(va12_motion.t)
        return float(np.mean((speed - va12_motion.nu[:, 0]) ** 2))

    assert misfit(4) > misfit(8) > misfit(16)


@pytest.mark.parametrize(
    ("most", "shortest", "words"),
    [(1, 2.0, "at least 2"), (9, 0.0, "shortest"), (9, 40.0, "between 0.5 and 30 s"), (9, np.nan, "nan")],
)
def test_what_makes_no_phases_is_refused(
    va12: Model, va12_motion: Motion, most: int, shortest: float, words: str
) -> None:
    with pytest.raises(UndrivableError, match=words):
        ground.trace_from_motion(va12, va12_motion, shortest, most)


def test_a_machine_without_wheels_has_no_driver(emps: Model) -> None:
    with pytest.raises(UndrivableError, match="emps"):
        ground.find_levers(emps)


@pytest.mark.parametrize(
    ("name", "joints"),
    [
        ("va12", ["articulation"]),
        ("three_wheel", ["steering"]),
        ("skid_robot", []),
        ("tandem", ["front steering", "rear steering"]),
        ("double_loader", ["articulation", "axle steering"]),
    ],
)
def test_steered_joints_have_the_machines_names(name: str, joints: list[str]) -> None:
    """A machine without any is asked for none."""
    model = build(load_machine(name))
    angle = np.outer([0.0, 0.1, 0], np.ones(len(joints)))
    trace = Trace(np.array([0.0, 4, 8]), np.array([0.0, 1, 0]), angle, ground.find_levers(model))
    assert [lever["name"] for lever in page.driver_data(model, trace, name)["levers"]] == joints
    text = page.driver_page(model, trace, name)
    assert [f'<div class="name">{joint}</div>' in text for joint in joints] == [True] * len(joints)
    assert "articulation" in joints or "articulation" not in text


def test_words_say_what_to_do(va12: Model) -> None:
    (lever,) = ground.find_levers(va12)
    assert lever.left == -1
    trace = Trace(KNOTS, SPEED, -ANGLE, (lever,))
    assert [ground.phase_words(trace, k) for k in range(len(trace))] == [
        "accelerate to 1.5 m/s in 4 s, straight",
        "hold 1.5 m/s for 5 s, steer to 20° left",
        "brake to a stop in 3 s, keep 20° left",
        "stand still for 3 s, straighten up",
        "accelerate backward to 1.2 m/s in 4 s, straight",
        "hold 1.2 m/s backward for 4 s, steer to 10° right",
        "brake to a stop in 4 s, straighten up",
    ]
    slower = Trace(np.array([0.0, 3, 6, 9]), np.array([0.0, -1.5, -0.5, 0]), np.zeros((4, 0)), ())
    assert ground.phase_words(slower, 1) == "slow down to 0.5 m/s backward in 3 s"
    through = Trace(np.array([0.0, 2, 5, 7]), np.array([0.0, 1, -0.5, 0]), np.zeros((4, 0)), ())
    assert ground.phase_words(through, 1) == "through a stop at 0:04 to 0.5 m/s backward in 3 s"
    assert ground.phase_words(through, 1, letters=True).startswith("through a stop A at 0:04")
    assert ground.reversal_times(through) == pytest.approx([4.0], abs=0.2)
    assert ground.reversal_times(trace) == pytest.approx([15.0], abs=0.2)
    named = [ground.phase_words(trace, k, letters=True) for k in range(len(trace))]
    assert [words for words in named if "stop A" in words] == ["brake to a stop A in 3 s, keep 20° left"]


@pytest.mark.parametrize("seed", range(5))
def test_every_change_of_direction_on_the_map_is_in_the_table(va12: Model, seed: int) -> None:
    """Through a stop or with a rest between, each letter stands in one row, in order."""
    rng = np.random.default_rng(seed)
    speed = np.array([0.0, *rng.choice([-1.2, -0.1, 0, 0.1, 1.5], 25), 0])
    trace = Trace(3.0 * np.arange(len(speed)), speed, np.zeros((len(speed), 1)), ground.find_levers(va12))
    turns = ground.reversal_times(trace)
    rows = [ground.phase_words(trace, k, letters=True) for k in range(len(trace))]
    found = [row.partition(" stop ")[2].split()[0] for row in rows if " stop " in row]
    assert [name for name in found if name not in ("at", "in")] == [
        ground.reversal_letter(k) for k in range(len(turns))
    ]


@pytest.mark.parametrize(
    ("x", "y", "degrees", "words"),
    [
        (-3.1, -4.1, 42.4, "3.1 m behind the lane's middle and 4.1 m right of it, pointing 42° left; articulation"),
        (5.9, 3.5, -208, "5.9 m ahead of the lane's middle and 3.5 m left of it, pointing 152° left; articulation"),
        (0, 0, -20, "level with the lane's middle and on its line, pointing 20° right; articulation straight."),
        (0, 1, 180.2, "level with the lane's middle and 1.0 m left of it, pointing back; articulation straight."),
        (2, 0, 360, "2.0 m ahead of the lane's middle and on its line, pointing ahead; articulation straight."),
    ],
)
def test_where_to_start_is_said(va12: Model, x: float, y: float, degrees: float, words: str) -> None:
    motion = motion_of(va12, np.zeros(2), np.zeros(2))
    motion.q[:, :3] = [x, y, np.deg2rad(degrees)]
    trace = Trace(KNOTS, SPEED, ANGLE, ground.find_levers(va12))
    said = ground.start_words(va12, motion, trace)
    x, y = ground.contact_edges(va12, motion)[0].mean(axis=0)[0]
    tape = f"By tape: {x + 20:.1f} m from the lane's near end, {y + 10:.1f} m from its right side."
    assert ground.start_words(va12, motion, trace, (40.0, 20.0)) == f"{said} {tape}"
    assert said.startswith(f"Start, seen along the lane: the middle of the front roll {words}")


def test_a_lane_that_can_only_be_followed_needs_no_place(straight: Model) -> None:
    motion = motion_of(straight, np.zeros(2), np.zeros(2))
    assert ground.start_words(straight, motion, Trace(KNOTS, SPEED, np.zeros((8, 0)), ())) == ""


def test_words_name_each_of_several_joints() -> None:
    front, rear = ground.find_levers(build(load_machine("tandem")))
    degrees = np.array([[0.0, 0], [20, 0], [20, -10], [20, -10], [0, -10], [0, 0]])
    times, speed = np.arange(0, 18, 3.0), np.array([0.0, 1, 1, 1, 1, 0])
    trace = Trace(times, speed, np.deg2rad(degrees) * [front.left, rear.left], (front, rear))
    assert [", ".join(ground.phase_parts(trace, k)[1]) for k in range(len(trace))] == [
        "front steering to 20° left, rear steering straight",
        "keep front steering 20° left, rear steering to 10° right",
        "keep front steering 20° left, keep rear steering 10° right",
        "straighten front steering, keep rear steering 10° right",
        "front steering straight, straighten rear steering",
    ]
    rows = ground.trace_table(trace)
    assert rows[1]["rear_steering_rad"] == pytest.approx([0, -rear.left * np.deg2rad(10)])
    again = ground.trace_from_table(build(load_machine("tandem")), rows)
    assert again.angle == pytest.approx(trace.angle)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"articulation_rad": "angle_rad"}, r"another version or machine \(no column articulation_rad\), design again"),
        ({"end_s": "end"}, "damaged, design again"),
    ],
)
def test_phases_that_cannot_be_read_are_refused(va12: Model, change: dict[str, str], why: str) -> None:
    trace = Trace(KNOTS, SPEED, ANGLE, ground.find_levers(va12))
    rows = [{change.get(name, name): value for name, value in row.items()} for row in ground.trace_table(trace)]
    with pytest.raises(UndrivableError, match=why):
        ground.trace_from_table(va12, rows)


@pytest.mark.parametrize("name", ["va12", "tandem", "double_loader"])
def test_left_is_where_the_machine_goes(name: str) -> None:
    """The sign from pure rolling is what simulation does: forward, each joint alone to its left, the machine turns
    left; all of them to the left it turns more, to different sides less than with the first alone."""
    model = build(load_machine(name))
    levers = ground.find_levers(model)

    def heading(*sides: int) -> float:
        angle = np.outer([0.0, 1, 1], 0.2 * np.multiply(sides, [lever.left for lever in levers]))
        trace = Trace(np.array([0.0, 4, 10]), np.array([0.0, 1, 1]), angle, levers)
        return float(ground.follow_trace(model, trace, STEADY_DRIVER, 0).q[-1, model.coordinates.index("theta0")])

    alone = [heading(*row) for row in np.eye(len(levers), dtype=int)]
    assert min(alone) > 0.1
    if len(levers) > 1:
        assert heading(1, 1) > 1.5 * min(alone)
        assert abs(heading(1, -1)) < 0.5 * max(alone)


def test_a_straight_lane_has_nothing_to_steer(straight: Model) -> None:
    assert ground.find_levers(straight) == ()


@pytest.mark.parametrize("name", ["tandem", "double_loader"])
def test_several_joints_are_followed_by_one_person(name: str) -> None:
    """The study's design as phases within the machine; each joint stays in its band, also where the soil resists its
    turning much more than its own inertia does."""
    model = build(load_machine(name))
    drawn = json.loads((RESULTS / "machines" / name / "drive.json").read_text())
    torque = Manoeuvre(np.array(drawn["times_s"]), np.array(drawn["torque"])).sample(100.0)
    motion = simulate(model, torque, q0=np.array(drawn["start"]))
    trace = ground.trace_from_motion(model, motion)
    assert np.ptp(trace.angle, axis=0).min() > 3 * ground.ANGLE_STEP
    _, widest, swing = ground.trace_bounds(model)
    assert (np.abs(trace.angle).max(axis=0) <= widest).all()
    assert (np.abs(np.diff(trace.angle, axis=0)) <= np.outer(np.diff(trace.times), swing) + 1e-9).all()
    person = ground.follow_trace(model, trace, None, 1, motion.q[0])
    wanted = trace.at(person.t)[1]
    rows = [model.coordinates.index(lever.body.coordinates[0]) for lever in trace.levers]
    for got, reference in zip(person.q[:, rows].T, wanted.T, strict=True):
        low, high = ground.tolerance_band(person.t, reference, ground.BAND_ANGLE)
        assert np.mean((got >= low) & (got <= high)) > 0.9


@pytest.mark.slow
def test_a_design_with_two_steered_joints_is_sheet_and_page(excite: Excite, tmp_path: Path) -> None:
    """By the real commands, from a design to what goes into the cab."""
    code, _, err = excite("design", "tandem", "--duration", 8, "--starts", 1, "--budget", 30, "--out", tmp_path / "d")
    assert code == 0, err
    code, shown, err = excite("drive", tmp_path / "d", "--phases", 4, "--out", tmp_path / "cab", "--json")
    assert code == 0, err
    said = json.loads(shown)
    assert {"front_steering_rad", "rear_steering_rad"} <= set(said["phases"][0])
    assert any("to different sides they move it sideways" in line for line in said["warnings"])
    header = (tmp_path / "cab" / "phases.csv").read_text().splitlines()[0]
    assert header == "t_s,v_m_s,front_steering_rad,rear_steering_rad"
    assert (tmp_path / "cab" / "sheet.pdf").read_bytes().count(b"/Type /Page ") == 2


def test_room_of_a_straight_pass_is_its_length_and_the_rolls_width(straight: Model) -> None:
    """10 m forward: the axles are 3.2 m apart, the rolls 2.1 m wide."""
    motion = motion_of(straight, np.zeros(101), np.zeros(101))
    motion.q[:, 0] = np.linspace(0, 10, 101)
    room = ground.touched_ground(straight, [motion])
    assert room.length == pytest.approx(10 + 1.45 + 1.75)
    assert room.width == pytest.approx(2.1)
    assert room.corner == pytest.approx((-3.2, -1.05))


def test_edges_turn_with_the_articulation(va12: Model) -> None:
    motion = motion_of(va12, np.zeros(2), np.full(2, 0.5))
    front, rear = ground.contact_edges(va12, motion)[:, :, 0]
    assert front[1] - front[0] == pytest.approx([0, 2.1])
    assert rear[1] - rear[0] == pytest.approx([-2.1 * np.sin(0.5), 2.1 * np.cos(0.5)])
    assert rear.mean(axis=0) == pytest.approx([-1.45 - 1.75 * np.cos(0.5), -1.75 * np.sin(0.5)])


@pytest.mark.parametrize("degrees", [0.0, 50.0, 170.0])
def test_a_drive_starts_along_the_lane_where_it_fits(va12: Model, va12_motion: Motion, degrees: float) -> None:
    """Whatever the heading it was found with; on a lane that is too narrow for that it lies as before."""
    start = va12_motion.q[0].copy()
    start[:3] = 3.0, -1.0, np.deg2rad(degrees)
    motion = trajectories.move_motion(va12, va12_motion, start)
    problem = va12.machine.problems["R60"].model_copy(update={"lane_m": (40.0, 20.0)})
    (placed,) = ground.place_in_lane(va12, problem, (motion,))
    assert placed.q[0, 2] == pytest.approx(0, abs=1e-9)
    assert trajectories.lane_excess(trajectories.check_limits(va12, problem, placed)) == 0
    assert placed.nu is motion.nu  # moved, not driven anew
    path = placed.q[:, :2] - placed.q[0, :2]
    assert np.hypot(*path.T) == pytest.approx(np.hypot(*(motion.q[:, :2] - motion.q[0, :2]).T))

    used = np.ptp(placed.q[:, :2], axis=0)
    narrow = problem.model_copy(update={"lane_m": (used[0] + 3, 0.8 * used[1])})
    assert trajectories.place_along_lane(va12, narrow, [motion]) is None

    corners = ((-20.0, -10.0), (20.0, -10.0), (20.0, 10.0), (-20.0, 10.0))
    area = problem.model_copy(update={"lane_m": None, "lane_polygon_m": corners})
    start = trajectories.place_along_lane(va12, area, [motion])
    assert start is not None
    moved = trajectories.move_motion(va12, motion, start)
    assert trajectories.lane_excess(trajectories.check_limits(va12, area, moved)) == 0


@pytest.mark.parametrize(
    ("length", "words"),
    [
        (20.0, "That lies within the lane of 40 m x 20 m."),
        (38.0, "The machine stays on the lane of 40 m x 20 m, but keep 2.0 m beyond its ends free."),
        (44.0, "The machine leaves the lane of 40 m x 20 m, by 2.0 m: keep 5.0 m beyond its ends free."),
    ],
)
def test_the_ground_that_a_person_needs_is_compared_with_the_lane(length: float, words: str) -> None:
    room = ground.TouchedGround(length, 6.0, (-length / 2, -3.0))
    assert room.words((40.0, 20.0)) == words
    assert room.summary((40.0, 20.0))["beyond_lane_m"] == pytest.approx([length / 2 - 20, -7])
    assert room.words((np.inf, np.inf)) == ""
    assert "lane_m" not in room.summary((np.inf, np.inf))


def test_moved_motion_is_the_same_motion_elsewhere(va12: Model, va12_motion: Motion) -> None:
    """The equations don't know the place: driving the same torques from the new start gives the moved path."""
    start = va12_motion.q[0].copy()
    start[:3] = [3.0, -2.0, 0.7]
    short = simulate(va12, va12_motion.u[:801], q0=start)
    assert trajectories.move_motion(va12, va12_motion, start).q[:801] == pytest.approx(short.q, abs=1e-6)


def first_page(model: Model, lane: tuple[float, float], speed: float = 1.5) -> Figure:
    """The sheet of a drive forward and back, some metres long."""
    levers = ground.find_levers(model)
    t = np.array([0.0, 2, 6, 8, 10, 12, 14, 16])
    v = np.array([0.0, speed, speed, 0, 0, -0.5, -0.5, 0])
    trace = Trace(t, v, -np.deg2rad([[0.0], [0], [0], [-14], [-14], [0], [0], [0]])[:, : len(levers)], levers)
    motions = (ground.follow_trace(model, trace, STEADY_DRIVER, 0),)
    made = sheet.Sheet("A drive", model, trace, motions, ground.touched_ground(model, motions), lane, (), (), "Good.")
    figure = sheet._first(made)
    figure.draw_without_rendering()
    return figure


@pytest.mark.parametrize(("lane", "seen"), [((20.0, 10.0), True), ((300.0, 100.0), False), ((4.0, 100.0), True)])
def test_the_legend_names_what_the_map_shows(va12: Model, lane: tuple[float, float], seen: bool) -> None:
    ax = first_page(va12, lane).axes[0]
    names = [text.get_text() for text in ax.get_legend().get_texts()]
    assert (f"lane {lane[0]:g} x {lane[1]:g} m" in names) == seen
    if lane[0] == 20:  # about as large as the drive: all of it
        assert ax.get_xlim()[0] < -10 < 10 < ax.get_xlim()[1]
        assert ax.get_ylim()[0] < -5 < 5 < ax.get_ylim()[1]
    assert "backward" in names
    backward = [text.get_text() for text in first_page(va12, lane, -1.0).axes[0].get_legend().get_texts()]
    assert not {"forward", "change of direction A, B, ..."} & set(backward)


def test_start_is_not_printed_over_the_machine(va12: Model) -> None:
    ax = first_page(va12, (40.0, 20.0)).axes[0]
    (start,) = [text for text in ax.texts if text.get_text() == "START"]
    rolls = [patch for patch in ax.patches if patch.get_edgecolor()[:3] == (0, 0, 0) and patch.get_zorder() == 4]
    assert len(rolls) == 2
    name = Text.get_window_extent(start)  # without the line to its place
    for roll in rolls:
        assert not name.overlaps(roll.get_window_extent())


def test_angles_on_the_sheet_have_sides_and_no_sign(va12: Model) -> None:
    """As the page has them: left is up, right is down, said in words."""
    ax = first_page(va12, (40.0, 20.0)).axes[2]
    labels = [label.get_text() for label in ax.get_yticklabels()]
    assert labels
    assert all(float(label) >= 0 for label in labels)
    up, down = (next(text for text in ax.texts if text.get_text() == side) for side in ("left", "right"))
    assert up.get_position()[1] > down.get_position()[1]
    assert ax.lines[0].get_ydata().min() == pytest.approx(-14)  # right


def test_stops_at_one_place_are_one_mark() -> None:
    place = np.array([1.0, 2.0])
    marks = [("o", "START", place), ("D", "A", place), ("D", "B", place + 0.1), ("D", "C", place + 5)]
    merged = sheet._merged(marks, 10.0)
    assert [text for _, text, _ in merged] == ["START", "A, B", "C"]


def test_names_on_the_map_do_not_hide_each_other() -> None:
    """Eight changes of direction within two metres, a metre on 11 points of paper: no name on another or on a mark."""
    rng = np.random.default_rng(1)
    marks = [("D", ground.reversal_letter(k), rng.uniform(0, 2, 2) * [3, 1]) for k in range(8)]
    figure = Figure(figsize=(5, 5))
    ax = figure.subplots()
    ax.set_position((0, 0, 1, 1))
    ax.set_xlim(-10, 22.7)
    ax.set_ylim(-16, 16.7)
    sheet._mark(ax, marks, 360 / 32.7)
    figure.draw_without_rendering()
    boxes = [t.get_window_extent() for t in ax.texts]
    for one, other in itertools.combinations(boxes, 2):
        assert not one.overlaps(other)


@pytest.mark.parametrize(
    "names", [("va12",), ("tandem",), ("double_loader",), ("tandem", "double_loader"), ("skid_robot",)]
)
@pytest.mark.parametrize("n", [8, 30])
def test_texts_on_the_second_page_do_not_overlap(names: tuple[str, ...], n: int) -> None:
    """The longest words that a phase can have, with no joint to steer, one, two or four."""
    models = [build(load_machine(name)) for name in names]
    levers = tuple(lever for model in models for lever in ground.find_levers(model))
    speed = np.where(np.arange(n + 1) % 2, 1.1, -1.1)
    speed[[0, -1]] = 0
    angle = np.outer(np.where(np.arange(n + 1) % 3, -0.3, 0.35), np.ones(len(levers)))
    trace = Trace(4.05 * np.arange(n + 1), speed, angle, levers)
    room = ground.TouchedGround(20, 10, (0, 0))
    figure = sheet._second(
        sheet.Sheet("A drive", models[0], trace, (), room, (60, 10), ("Mind the gap.",), (), "Good.")
    )
    assert any("through a stop" in text.get_text() for text in figure.texts)
    boxes = [text.get_window_extent() for text in figure.texts]
    for one, other in itertools.combinations(boxes, 2):
        assert not one.overlaps(other)
    assert max(box.x1 for box in boxes) <= 0.96 * figure.bbox.width


def test_band_is_the_reference_a_second_around() -> None:
    t = np.arange(0, 10, 0.1)
    step = np.where(t < 5, 0.0, 1.0)
    low, high = ground.tolerance_band(t, step, 0.1)
    assert high[t < 3.9] == pytest.approx(0.1)
    assert high[t > 4.05] == pytest.approx(1.1)
    assert low[t < 5.9] == pytest.approx(-0.1)
    assert low[t > 6.05] == pytest.approx(0.9)


PLAYED = ground.DriveQuality(100, 1.0, "M", 0.2)
LOST = ground.DriveQuality(100, 3.0, "M", 0.2)


@pytest.mark.parametrize("objective", ["accuracy", "cond"])
def test_a_design_for_drivers_is_not_sent_there_again(objective: str) -> None:
    assert "--driver" in driving_aids.verdict(PLAYED, LOST, objective)
    said = driving_aids.verdict(PLAYED, LOST, objective, by_hand=True)
    assert "too much is lost" in said
    assert "--driver" not in said
    assert ("--objective accuracy" in said) == (objective == "cond")
    assert all(way in said for way in ("--duration", "--starts", "--budget (untried)", "play back the torques"))
    assert "leave out --phases" in driving_aids.verdict(PLAYED, LOST, objective, by_hand=True, fewer=True)


def test_limits_that_a_person_exceeds_stand_with_the_verdict() -> None:
    person, over = replace(PLAYED, median_percent=0.32), {"power": 0.06}
    said = driving_aids.verdict(PLAYED, person, over=over, slower=(0.9, replace(PLAYED, worst_percent=1.3)))
    assert said.endswith(
        "good enough to drive. But a person exceeds limits, power by 6 % of its range: stay 10 % below all speeds, with"
        " which simulated people keep them and identify the worst parameter to 1.3 %."
    )
    said = driving_aids.verdict(PLAYED, person, over=over)
    assert said.endswith("slower driving doesn't keep them, design again with --driver (untried).")
    said = driving_aids.verdict(PLAYED, person, by_hand=True, over={**over, "rim_speed": 0.03})
    assert "power by 6 %, rim speed by 3 % of their range: design again with them so much tighter" in said
    assert "--driver" not in said
    assert "below" not in said


def test_a_person_is_judged_by_the_accuracy_that_is_asked() -> None:
    """Three times the error of torques played back is good if 3.5 % were asked, and bad if 2 % were."""
    assert "accurate enough, the worst parameter comes to 3 %" in driving_aids.verdict(PLAYED, LOST, asked=3.5)
    said = driving_aids.verdict(PLAYED, LOST, asked=2.0)
    assert "not accurate enough, the worst parameter comes to 3 %, needed are 2 %; design again with --driver" in said


@pytest.mark.parametrize(
    ("median", "worst", "words"),
    [
        (1.6, 1.04, "attains 1.6 times the median error of torques played back exactly and is as good in the worst"),
        (0.98, 1.4, "attains 0.98 times the median error and 1.4 times the worst error of torques"),
        (1.0, 1.4, "attains 1.4 times the worst error of torques played back exactly and is as good in the median"),
        (1.01, 1.0, "is as good as torques played back exactly: nothing that counts is lost."),
    ],
)
def test_errors_that_are_the_same_are_said_to_be_so(median: float, worst: float, words: str) -> None:
    assert words in driving_aids.verdict(PLAYED, ground.DriveQuality(100, worst, "M", 0.2 * median))


def test_speeds_that_keep_the_limits_are_found(va12: Model) -> None:
    """A start that needs too much power: on speeds a tenth lower people keep it, on a twentieth they don't."""
    problem = va12.machine.problems["R60"]
    trace = Trace(np.array([0.0, 1.6, 8, 12]), np.array([0.0, 1.6, 1.6, 0]), np.zeros((4, 1)), ground.find_levers(va12))

    def exceeded(share: float) -> set[str]:
        slow = replace(trace, speed=share * trace.speed)
        return set(
            driving_aids._exceeded_limits(
                va12, problem, tuple(ground.follow_trace(va12, slow, None, k) for k in range(driving_aids.PEOPLE))
            )
        )

    assert exceeded(1) == {"power"}
    slower = driving_aids._slower_drive(va12, problem, trace, np.zeros(len(va12.coordinates)), 0)
    assert slower is not None
    assert slower[0] == 0.9
    assert slower[1].worst_percent > 0
    assert [exceeded(0.95), exceeded(0.9)] == [{"power"}, set()]


@pytest.mark.slow
def test_what_a_person_keeps_of_the_accurate_drive() -> None:
    """Some fifteen phases by hand cost about twice the error of torques played back; the sheet says which it is."""
    design = saved_design.read_design(RESULTS / "R60_accuracy" / "design")
    made = driving_aids.prepare(design)
    scores = dict(made.scores)
    played, person = scores[driving_aids.PLAYED_BACK], scores[driving_aids.PHASED]
    assert played.worst_percent == pytest.approx(max(design.summary["sigma_percent"].values()), rel=0.02)
    assert len(made.trace) <= 20
    ratio = max(person.median_percent / played.median_percent, person.worst_percent / played.worst_percent)
    assert 1 < ratio < 2.2
    assert ("good enough" in made.verdict, "too much is lost" in made.verdict) == (ratio <= 2, ratio > 2)
    ways = np.sign(made.trace.speed[np.abs(made.trace.speed) > 0.02])
    assert any(f"direction {np.count_nonzero(np.diff(ways))} times" in line for line in made.warnings)
    lost = ground.DriveQuality(1, 3 * played.worst_percent, "M", played.median_percent)
    assert "too much is lost" in driving_aids.verdict(played, lost)
    lines = sheet.set_up_lines(design.model.machine)
    assert all(any(line.startswith(f"{s.column} [") for line in lines) for s in design.model.machine.sensor)


def test_drive_command_writes_two_pages(excite: Excite, tmp_path: Path) -> None:
    out, design = tmp_path / "cab", RESULTS / "S40" / "design"
    code, stdout, stderr = excite("drive", design, "--phases", 8, "--out", out, "--json")
    assert (code, stderr) == (0, "")
    shown = json.loads(stdout)
    assert shown == json.loads((out / "summary.json").read_text())
    assert len(shown["phases"]) <= 8
    assert shown["phases"][-1]["speed_m_s"][1] == 0
    pdf = (out / "sheet.pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert pdf.count(b"/Type /Page ") == 2
    assert b"/MediaBox [ 0 0 595.44 841.68 ]" in pdf
    code, _, stderr = excite("drive", design, "--shortest", 100)
    assert code == 2
    assert "between 0.5 and 20 s" in stderr
    code, _, stderr = excite("drive", tmp_path)
    assert code == 2
    assert "excite design" in stderr


def test_the_sheet_speaks_the_logger_s_units(va12: Model) -> None:
    """Noise in the unit of the column, whatever unit the file gives it in: 0.002 rad/s are 0.115 deg/s."""
    rate = next(s for s in va12.machine.sensor if s.kind == "yaw_rate")
    assert sheet.sensor_line(va12.machine, rate).endswith("noise below 0.002 rad/s; optional")
    degrees = rate.model_copy(update={"unit": "deg/s"})
    assert sheet.sensor_line(va12.machine, degrees).endswith("noise below 0.002 deg/s; optional")
    told = degrees.model_copy(update={"noise_unit": "rad/s"})
    assert sheet.sensor_line(va12.machine, told).endswith("noise below 0.115 deg/s; optional")
