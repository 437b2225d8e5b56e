"""`fbse init`: from a URDF to a robot that stands."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from fbse_drake import InputError, init_robot, load_scenario, simulate
from fbse_drake.cli import BAD_INPUT, main
from fbse_drake.interop.mapping import load_map
from fbse_drake.resources import folder
from fbse_drake.robot.plant import Robot, make_robot
from fbse_drake.robot.proposal import propose

STRIDER = folder("models") / "strider.urdf"
QUADRUPED = folder("models") / "quadruped.urdf"


def changed(tmp_path: Path, change, urdf: Path = STRIDER) -> Path:
    """A URDF, Strider's by default, with something about it changed."""
    tree = ElementTree.parse(urdf)
    change(tree.getroot())
    tree.write(tmp_path / "robot.urdf")
    return tmp_path / "robot.urdf"


def without_soles(root: ElementTree.Element) -> None:
    for part in [*root.findall("link"), *root.findall("joint")]:
        if "sole" in part.get("name"):
            root.remove(part)


def without_limits(root: ElementTree.Element) -> None:
    for limit in root.iter("limit"):
        limit.set("lower", "0")
        limit.set("upper", "0")


def test_legs_soles_and_imu_are_those_of_the_shipped_description():
    proposed = propose(STRIDER, "strider.urdf").description
    known = make_robot("strider")[0].description
    assert (proposed.base, proposed.imu) == (known.base, known.imu)
    assert proposed.leg_joints == known.leg_joints
    for side in ("left", "right"):
        assert proposed.legs[side].joints == known.legs[side].joints
        assert proposed.legs[side].foot == known.legs[side].foot
        assert proposed.legs[side].sole == known.legs[side].sole


def test_a_sole_without_a_frame_gets_one_where_the_foot_meets_the_ground(tmp_path: Path):
    """The same plane and the same corners as with the frame that was taken away."""
    proposed = propose(changed(tmp_path, without_soles), "robot.urdf").description
    assert list(proposed.frames) == ["left_sole", "right_sole"]
    (tmp_path / "with.yaml").write_text(
        init_robot._description_text(propose(STRIDER, str(STRIDER)).description, "strider", [])
    )
    (tmp_path / "without.yaml").write_text(init_robot._description_text(proposed, "robot", []))
    robots = [make_robot(tmp_path / f"{name}.yaml")[0] for name in ("with", "without")]
    for side in ("left", "right"):
        corners = []
        for robot in robots:
            context = robot.plant.CreateDefaultContext()
            X_BS = robot.sole(side).CalcPose(context, robot.base.body_frame())
            corners.append(X_BS.multiply(robot.pad_positions(side).T).T)
        np.testing.assert_allclose(corners[0], corners[1], atol=2e-4)


def test_a_proposed_robot_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Without sole frames and without limits; from a folder of its own."""
    monkeypatch.setattr(init_robot, "_DURATION", 1.0)

    def worst(root: ElementTree.Element) -> None:
        without_soles(root)
        for limit in root.iter("limit"):
            if float(limit.get("lower")) < 0 < float(limit.get("upper")):
                limit.set("lower", "0")
                limit.set("upper", "0")

    made = init_robot.init_robot(changed(tmp_path, worst), tmp_path / "mine", name="mine")
    assert made.problems == []
    files = ["mine.map.yaml", "mine.png", "mine.yaml", "mine_squat.yaml"]
    assert sorted(path.name for path in made.scenario.parent.iterdir()) == files
    # The description is found beside the scenario, not in the working directory.
    scenario = load_scenario(made.scenario)
    run = simulate(scenario)
    assert run.failure is None
    robot, _ = make_robot(made.description)
    mass = robot.plant.CalcTotalMass(robot.plant.CreateDefaultContext())
    load = sum(run.log[f"foot/{side}/wrench"][1:, 5].mean() for side in run.log.sides)
    assert load == pytest.approx(9.81 * mass, rel=5e-3)
    assert load_map(made.log_map).joints == robot.joint_names
    with pytest.raises(InputError, match="this exists already"):
        init_robot.init_robot(tmp_path / "robot.urdf", tmp_path / "mine", name="mine")


def test_limits_of_0_and_0_are_none(tmp_path: Path):
    path = changed(tmp_path, without_limits)
    (tmp_path / "robot.yaml").write_text(
        init_robot._description_text(propose(path, "robot.urdf").description, "robot", [])
    )
    robot, _ = make_robot(tmp_path / "robot.yaml")
    assert not np.isfinite(robot.plant.GetPositionLowerLimits()[robot.position_index]).any()


@pytest.mark.parametrize(("model", "joints"), [("pendulum", 1), ("arm", 6)])
def test_whatever_has_no_two_legs_swings_its_joints(
    model: str, joints: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(init_robot, "_DURATION", 0.5)
    made = init_robot.init_robot(folder("models") / f"{model}.urdf", tmp_path)
    assert made.problems == []
    assert len(load_scenario(made.scenario).robot.effects) == 0
    assert len(make_robot(made.description)[0].joint_names) == joints


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda root: [
                link.remove(shape)
                for link in root.iter("link")
                for shape in [*link.findall("collision"), *link.findall("visual")]
            ],
            r"l_foot has no shape, so nothing says where the left foot meets the ground",
        ),
        (
            lambda root: [root.remove(joint) for joint in root.findall("joint")],
            r"robot\.urdf: no joint turns or slides",
        ),
    ],
)
def test_what_cannot_be_told_is_said(change, message: str, tmp_path: Path):
    with pytest.raises(InputError, match=message):
        propose(changed(tmp_path, change), "robot.urdf")


def described(tmp_path: Path, urdf: Path):
    """The robot as proposed, and what was said of it."""
    proposal = propose(urdf, str(urdf))
    text = init_robot._description_text(proposal.description, "robot", [])
    (tmp_path / "described.yaml").write_text(text)
    return make_robot(tmp_path / "described.yaml")[0], proposal.remarks


def standing(robot: Robot) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Where its feet are in the base in the proposed posture, and how far they are turned from
    up."""
    names, context = robot.description, robot.plant.CreateDefaultContext()
    robot.set_joint_positions(context, names.per_joint(names.stance, key="stance", default=0.0))
    poses = {
        side: robot.sole(side).CalcPose(context, robot.base.body_frame()) for side in names.sides
    }
    tilt = [np.arccos(np.clip(X.rotation().matrix()[2, 2], -1, 1)) for X in poses.values()]
    return {side: X.translation() for side, X in poses.items()}, np.array(tilt)


def test_point_feet_are_where_the_shipped_description_has_its_pads(tmp_path: Path):
    robot, _ = described(tmp_path, QUADRUPED)
    known = make_robot("quadruped")[0]
    names, shipped = robot.description, known.description
    assert (names.base, names.imu) == (shipped.base, shipped.imu)
    assert names.leg_joints == shipped.leg_joints
    posture = np.random.default_rng(0).uniform(-1, 1, len(known.joint_names))
    for side, leg in shipped.legs.items():
        assert names.legs[side].joints == leg.joints
        assert names.legs[side].is_point
        assert not names.legs[side].has_six_axes
        places = []
        for each in (robot, known):
            context = each.plant.CreateDefaultContext()
            each.set_joint_positions(context, posture)
            places.append(each.sole(side).CalcPose(context, each.base.body_frame()).translation())
        np.testing.assert_allclose(*places, atol=2e-6)
    # Level and upright, below the hips, four fifths of the legs' length below them.
    feet, tilt = standing(robot)
    np.testing.assert_allclose(tilt, 0.0, atol=1e-4)
    for side, place in feet.items():
        front, left = (1 if word in side else -1 for word in ("front", "left"))
        np.testing.assert_allclose(place, [0.25 * front, 0.17 * left, -0.4], atol=2e-3)


def without_ranges(root: ElementTree.Element) -> None:
    for limit in root.iter("limit"):
        limit.set("lower", "-10")
        limit.set("upper", "10")


def turned_shank(root: ElementTree.Element) -> None:
    """The knees' axes point to the right, so that they count the other way."""
    for joint in root.findall("joint"):
        if "knee" in joint.get("name"):
            joint.find("axis").set("xyz", "0 -1 0")
            limit = joint.find("limit")
            low, high = (float(limit.get(end)) for end in ("lower", "upper"))
            limit.set("lower", str(-high))
            limit.set("upper", str(-low))


def forwards(root: ElementTree.Element) -> None:
    """Limits with which knees bend forwards alone."""
    for joint in root.findall("joint"):
        ends = {"knee": ("0.2", "2.6"), "flexion": ("-2.0", "0.6")}
        for part, (low, high) in ends.items():
            if part in joint.get("name"):
                joint.find("limit").set("lower", low)
                joint.find("limit").set("upper", high)


@pytest.mark.parametrize(
    ("change", "knee", "is_said"),
    [(without_ranges, -1, True), (turned_shank, 1, False), (forwards, 1, False)],
)
def test_knees_bend_as_their_limits_allow(change, knee: int, is_said: bool, tmp_path: Path):
    """A motion of the feet is found, and its knees are where the proposed posture has them."""
    robot, remarks = described(tmp_path, changed(tmp_path, change, QUADRUPED))
    assert any("which way the knees bend" in remark for remark in remarks) == is_said
    squat, reference = init_robot._standing(robot)
    knees = [robot.joint_names.index(f"{side}_knee") for side in robot.description.sides]
    assert (knee * reference.joint_position[:, knees] > 0.8).all()
    assert squat.wheelbase == pytest.approx(0.5, abs=2e-3)


def test_a_foot_without_a_shape_is_taken_to_be_at_its_end_and_that_is_said(tmp_path: Path):
    def bare(root: ElementTree.Element) -> None:
        for link in root.iter("link"):
            if link.get("name").startswith("rear_left"):
                for shape in [*link.findall("collision"), *link.findall("visual")]:
                    link.remove(shape)

    robot, remarks = described(tmp_path, changed(tmp_path, bare, QUADRUPED))
    said = [remark for remark in remarks if "no shape" in remark]
    assert len(said) == 1
    assert "the rear_left foot is taken to be at the origin of rear_left_" in said[0]
    feet, _ = standing(robot)
    np.testing.assert_allclose(feet["rear_left"][2], feet["rear_right"][2], atol=2e-3)


def test_a_ball_touches_the_ground_below_its_middle(tmp_path: Path):
    def balls(root: ElementTree.Element) -> None:
        for sphere in root.iter("sphere"):
            sphere.set("radius", "0.02")

    robot, _ = described(tmp_path, changed(tmp_path, balls, QUADRUPED))
    names, context = robot.description, robot.plant.CreateDefaultContext()
    robot.set_joint_positions(context, names.per_joint(names.stance, key="stance", default=0.0))
    for side in names.sides:
        ball = robot.plant.GetFrameByName(f"{side}_pad").CalcPose(context, robot.base.body_frame())
        point = robot.sole(side).CalcPose(context, robot.base.body_frame())
        below = point.translation() - ball.translation()
        np.testing.assert_allclose(below, [0.0, 0.0, -0.02], atol=1e-5)


def turned_around(root: ElementTree.Element) -> None:
    for joint in root.findall("joint"):
        if "hip_abduction" in joint.get("name"):
            x, y, z = joint.find("origin").get("xyz").split()
            joint.find("origin").set("xyz", f"{-float(x)} {-float(y)} {z}")


def straight(root: ElementTree.Element) -> None:
    """Knees that hardly bend: the legs cannot be shortened."""
    for joint in root.findall("joint"):
        if "knee" in joint.get("name"):
            joint.find("limit").set("lower", "-0.1")
            joint.find("limit").set("upper", "0.1")


def test_a_base_that_looks_backwards_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"front_left_.* is on the (rear|right) side of trunk"):
        propose(changed(tmp_path, turned_around, QUADRUPED), "robot.urdf")


def test_legs_that_cannot_stand_swing_and_that_is_said(tmp_path: Path):
    proposal = propose(changed(tmp_path, straight, QUADRUPED), "robot.urdf")
    assert not proposal.description.legs
    assert len(proposal.description.joints) == 12
    assert re.search(
        r"front_left foot below its hip: it misses that by 9\d mm", proposal.remarks[1]
    )


def test_a_quadruped_stands_on_its_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(init_robot, "_DURATION", 0.6)
    made = init_robot.init_robot(QUADRUPED, tmp_path / "mine", name="mine")
    assert made.problems == []
    run = simulate(load_scenario(made.scenario))
    load = sum(run.log[f"foot/{side}/pad_force"][300:, 0, 2].mean() for side in run.log.sides)
    assert load == pytest.approx(9.81 * 26, rel=5e-3)
    channels = load_map(made.log_map).channels
    assert channels["foot/rear_left/pad_force"].columns == [
        f"rear_left_{axis}" for axis in ("fx", "fy", "fz")
    ]


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture):
    (tmp_path / "broken.urdf").write_text("<robot><link></robot>")
    for file, message in (
        ("nowhere.urdf", "nowhere.urdf: No such file or directory"),
        ("broken.urdf", "broken.urdf: not a URDF: mismatched tag"),
    ):
        out = tmp_path / "out"
        assert main(["init", str(tmp_path / file), "--out", str(out)]) == BAD_INPUT
        printed = capsys.readouterr().err
        assert message in printed
        assert printed.count("\n") == 1
        assert not list(out.iterdir())
    assert main(["init", str(STRIDER), "--name", "a: b"]) == BAD_INPUT
    assert "expected letters" in capsys.readouterr().err


def test_a_wrong_name_is_answered_with_those_that_exist(tmp_path: Path):
    text = (folder("models") / "strider.yaml").read_text()
    for wrong, names in (("base: trunk", "torso"), ("imu: gyro", "gyro_unit")):
        key = wrong.partition(":")[0]
        (tmp_path / "wrong.yaml").write_text(
            re.sub(rf"(?m)^{key}: .*$", wrong, text).replace(
                "directives: strider.dmd.yaml", f"urdf: {STRIDER}"
            )
        )
        with pytest.raises(InputError, match=rf"{key}: .*there are: .*{names}"):
            make_robot(tmp_path / "wrong.yaml")
