"""What a plant takes of a URDF, and what `fbse init` makes of robots unlike those that ship.

Inertias that no body has, no mass, a link called world, joints that slide or follow others.
"""

from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from scipy.spatial.transform import Rotation

from fbse_drake import InputError, init_robot, load_scenario
from fbse_drake.cli import BAD_INPUT, main
from fbse_drake.interop.mapping import load_map
from fbse_drake.robot.bare_urdf import bare_urdf
from fbse_drake.robot.plant import make_robot
from fbse_drake.robot.proposal import propose
from fbse_drake.scenario import build_robot

QUADRUPED = Path(init_robot.__file__).parents[1] / "models" / "quadruped.urdf"


def inertial(mass: float, inertia: np.ndarray, com: str = "0 0 -0.2") -> str:
    names = (
        ("ixx", 0, 0),
        ("iyy", 1, 1),
        ("izz", 2, 2),
        ("ixy", 0, 1),
        ("ixz", 0, 2),
        ("iyz", 1, 2),
    )
    values = " ".join(f'{name}="{float(inertia[i, j])!r}"' for name, i, j in names)
    return f'<inertial><origin xyz="{com}"/><mass value="{mass}"/><inertia {values}/></inertial>'


def robot_file(folder: Path, links: dict[str, str], joints: list[str], name: str = "robot") -> Path:
    body = [f'<link name="{link}">{content}</link>' for link, content in links.items()]
    (folder / f"{name}.urdf").write_text(f'<robot name="r">{"".join([*body, *joints])}</robot>')
    return folder / f"{name}.urdf"


def joint(name: str, kind: str, parent: str, child: str, more: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="0 1 0"/>{more}</joint>'
    )


def swinging(folder: Path, inertia: np.ndarray, mass: float = 0.5) -> Path:
    """A pendulum with this inertia about its centre of mass."""
    links = {"bench": "", "arm": inertial(mass, inertia)}
    return robot_file(folder, links, [joint("pivot", "continuous", "bench", "arm")])


def inertia_in_drake(urdf: Path) -> np.ndarray:
    """Of the link called arm about its centre of mass, (3, 3) [kg m^2]."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(bare_urdf(urdf).text, "urdf")
    plant.Finalize()
    M = plant.GetBodyByName("arm").default_spatial_inertia()
    return M.Shift(M.get_com()).CalcRotationalInertia().CopyToFullMatrix3()


def of_second_moments(along: np.ndarray, seed: int) -> np.ndarray:
    """Inertia of a body whose mass reaches so far along three axes, in a frame turned at random."""
    axes = Rotation.random(random_state=seed).as_matrix()
    return axes @ np.diag(along.sum() - along) @ axes.T


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("along", [(3e-4, 2e-4, 1e-4), (3e-4, 2e-4, 0.0), (3e-4, 0.0, 0.0)])
def test_what_a_body_can_have_is_taken_as_it_is(
    along: tuple[float, ...], seed: int, tmp_path: Path
):
    """A block, a plate without thickness, a rod without any."""
    inertia = of_second_moments(np.array(along), seed)
    urdf = swinging(tmp_path, inertia)
    assert bare_urdf(urdf).remarks == ()
    np.testing.assert_allclose(inertia_in_drake(urdf), inertia, rtol=0, atol=1e-15)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("along", [(3e-4, 2e-4, -1e-4), (3e-4, -1e-5, -1e-4)])
def test_where_mass_would_reach_less_than_nowhere_it_reaches_nowhere(
    along: tuple[float, ...], seed: int, tmp_path: Path
):
    """Drake takes it as it is written: it puts nothing else in its place."""
    urdf = swinging(tmp_path, of_second_moments(np.array(along), seed))
    possible = of_second_moments(np.maximum(along, 0.0), seed)
    np.testing.assert_allclose(inertia_in_drake(urdf), possible, rtol=0, atol=1e-11)
    (remark,) = bare_urdf(urdf).remarks
    assert remark.startswith("arm: no body has the principal moments of inertia ")


def test_links_that_are_wrong_alike_are_named_together_and_hygiene_says_so(tmp_path: Path):
    impossible = inertial(0.5, np.diag([1e-4, 1e-4, 5e-4]))
    urdf = robot_file(
        tmp_path,
        {"bench": "", "arm": impossible, "hand": impossible},
        [joint("one", "continuous", "bench", "arm"), joint("two", "continuous", "arm", "hand")],
    )
    made = init_robot.init_robot(urdf, tmp_path / "mine")
    assert made.remarks[0].startswith("arm, hand: no body has")
    (said,) = make_robot(made.description)[0].remarks
    assert said + "." == made.remarks[0]


def test_moments_of_inertia_without_a_mass_are_left_out(tmp_path: Path):
    """Drake would take a mass of 1 kg for granted."""
    urdf = robot_file(
        tmp_path,
        {"bench": inertial(0.0, 1e-3 * np.eye(3)), "arm": inertial(0.5, 1e-4 * np.eye(3))},
        [joint("pivot", "continuous", "bench", "arm")],
    )
    robot, _ = make_robot(init_robot.init_robot(urdf, tmp_path / "mine").description)
    assert robot.total_mass == pytest.approx(0.5)
    assert robot.remarks == ("bench: moments of inertia without a mass are left out",)


def test_a_robot_without_a_mass_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture):
    urdf = robot_file(
        tmp_path, {"bench": "", "arm": ""}, [joint("pivot", "continuous", "bench", "arm")]
    )
    assert main(["init", str(urdf), "--out", str(tmp_path / "mine")]) == BAD_INPUT
    printed = capsys.readouterr().err
    assert "no link has a mass" in printed
    assert printed.count("\n") == 1
    text = f"base: bench\nfixed_base: true\nurdf: {urdf}\njoints: [pivot]\n"
    (tmp_path / "robot.yaml").write_text(text)
    with pytest.raises(InputError, match="expected a robot with a mass"):
        make_robot(tmp_path / "robot.yaml")


def test_a_robot_that_is_fixed_to_a_link_called_world_has_a_fixed_base(tmp_path: Path):
    arm = inertial(0.5, 1e-4 * np.eye(3))
    urdf = robot_file(
        tmp_path,
        {"world": "", "bench": "", "arm": arm},
        [
            joint("mount", "fixed", "world", "bench", '<origin xyz="0 0 0.7"/>'),
            joint("pivot", "continuous", "bench", "arm"),
        ],
    )
    made = init_robot.init_robot(urdf, tmp_path / "mine")
    assert made.problems == []
    robot = build_robot(load_scenario(made.scenario).robot)
    assert (robot.description.base, robot.description.fixed_base) == ("bench", True)
    base = robot.plant.EvalBodyPoseInWorld(robot.plant.CreateDefaultContext(), robot.base)
    np.testing.assert_allclose(base.translation(), [0, 0, 0.7])


def test_joints_that_hang_on_the_world_and_slide_a_little(tmp_path: Path):
    """A cart within 4 mm, with a pole and what follows the pole."""
    pole = inertial(0.5, 1e-3 * np.eye(3))
    urdf = robot_file(
        tmp_path,
        {"world": "", "cart": inertial(1.0, 1e-2 * np.eye(3)), "pole": pole, "vane": pole},
        [
            joint("slide", "prismatic", "world", "cart", '<limit lower="0.002" upper="0.006"/>'),
            joint("pivot", "continuous", "cart", "pole"),
            joint("follows", "continuous", "cart", "vane", '<mimic joint="pivot"/>'),
        ],
    )
    made = init_robot.init_robot(urdf, tmp_path / "mine")
    assert made.problems == []
    assert "Joints that follow others are held at 0: follows." in made.remarks
    scenario = load_scenario(made.scenario)
    robot = build_robot(scenario.robot)
    assert robot.joint_names == ["slide", "pivot"]
    assert not robot.has_floating_base
    assert scenario.reference.posture["slide"] == pytest.approx(0.004)
    assert 0.0 < scenario.reference.amplitude["slide"] < 0.002
    # One unit cannot be that of both.
    assert load_map(made.log_map).channels["joint/position"].unit == ""
    narrow = ["reference.amplitude.slide=0.003"]
    with pytest.raises(InputError, match=r"needs slide at .* m, its limits are 0.002 to 0.006 m"):
        init_robot.simulate(load_scenario(made.scenario, overrides=narrow))


@pytest.mark.parametrize("mass", [0.02, 2000.0])
def test_the_proposed_drives_are_strong_enough(mass: float, tmp_path: Path):
    """Held out level, the arm of 2 t needs 3.9 kNm."""
    urdf = swinging(tmp_path, 1e-3 * mass * np.eye(3), mass)
    text = urdf.read_text().replace("0 0 -0.2", "0.2 0 0")
    urdf.write_text(text)
    made = init_robot.init_robot(urdf, tmp_path / "mine")
    assert made.problems == []


def test_a_robot_that_does_not_follow_is_a_problem(tmp_path: Path):
    urdf = swinging(tmp_path, 1e-4 * np.eye(3))
    made = init_robot.init_robot(urdf, tmp_path / "mine")
    weak = made.scenario.read_text().replace("control: {kp", "control: {torque_limit: {all: 0}, kp")
    made.scenario.write_text(weak.replace("posture: {}", "posture: {pivot: 1.0}"))
    _, (problem,) = init_robot._tried(made.scenario, make_robot(made.description)[0])
    assert "does not follow its plan but misses it by " in problem
    assert "mrad rms (pivot)" in problem


def test_a_base_that_lies_on_its_side_is_told_by_its_legs(tmp_path: Path):
    """Turned about its x axis: two legs of four end low."""
    text = QUADRUPED.read_text()
    lying = text.replace('<link name="trunk">', '<link name="tail"/><link name="trunk">', 1)
    turned = (
        '<joint name="turned" type="fixed"><parent link="tail"/><child link="trunk"/>'
        '<origin rpy="1.5707963 0 0"/></joint></robot>'
    )
    (tmp_path / "lying.urdf").write_text(lying.replace("</robot>", turned))
    proposal = propose(tmp_path / "lying.urdf", "lying.urdf")
    assert not proposal.description.legs
    assert any(
        remark.startswith("4 chains of 3 joints leave tail, of which only 2 end low")
        for remark in proposal.remarks
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<robot name="r"><link name="$(arg name)"/></robot>', "this is a xacro; expand it first"),
        (
            '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:leg/></robot>',
            "this is a xacro; expand it first",
        ),
        ("<mujoco/>", "expected <robot> as its root, found <mujoco>"),
    ],
)
def test_other_files_are_told_apart(text: str, message: str, tmp_path: Path):
    (tmp_path / "robot.urdf").write_text(text)
    with pytest.raises(InputError, match=message):
        propose(tmp_path / "robot.urdf", "robot.urdf")


def test_what_a_plant_does_not_take_may_be_any_text(tmp_path: Path):
    """As `$(find package)` in what a simulator reads."""
    urdf = swinging(tmp_path, 1e-4 * np.eye(3))
    gazebo = "<gazebo><plugin><file>$(find p)/c.yaml</file></plugin></gazebo></robot>"
    urdf.write_text(urdf.read_text().replace("</robot>", gazebo))
    assert bare_urdf(urdf).remarks == ()


def test_an_inertia_that_is_no_number_is_refused(tmp_path: Path):
    urdf = swinging(tmp_path, np.full((3, 3), np.nan))
    with pytest.raises(InputError, match="arm: its inertia is not finite"):
        propose(urdf, "robot.urdf")
