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
from fbse_drake.robot.plant import make_robot
from fbse_drake.robot.proposal import propose

STRIDER = folder("models") / "strider.urdf"


def changed(tmp_path: Path, change) -> Path:
    """Strider's URDF with something about it changed."""
    tree = ElementTree.parse(STRIDER)
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
