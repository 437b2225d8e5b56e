"""Can a recording be believed? What is wrong with its clocks, channels, units and frames, before
anybody looks for physics in it.

A log that makes the equation of motion meaningless is refused (`sanity.check_sensors`). What is
found here says what of a diagnosis is not to be believed; torques that are not to be trusted are
not explained (`Hygiene.trusted`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from fbse_drake.discrepancy.hygiene import channel_checks, model_checks
from fbse_drake.discrepancy.residual.evidence import Evidence, HygieneFinding, NoiseLevel
from fbse_drake.discrepancy.residual.noise import Noise, noise_finding
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.errors import InputError
from fbse_drake.robot.plant import Robot
from fbse_drake.scenario import Scenario

_CHECKS = (*channel_checks.CHECKS, *model_checks.CHECKS)
# What makes the torque of a joint worthless throughout.
_WHOLE_LOG = (
    "clock_offset",
    "dead_torque",
    "joint_direction",
    "joint_zero",
    "mount",
    "not_a_torque",
    "ringing",
    "swapped_joints",
    "torque_scale",
    "torque_sign",
    "without_gravity",
)
_ORDER = ("untrustworthy", "warning", "note")


@dataclass(frozen=True)
class Hygiene:
    """Everything that is remarkable about a recording, worst first, and the noise of its
    channels."""

    findings: tuple[HygieneFinding, ...] = ()
    noise: tuple[NoiseLevel, ...] = ()

    @property
    def untrustworthy(self) -> list[HygieneFinding]:
        return [finding for finding in self.findings if finding.severity == "untrustworthy"]

    def untrusted_joints(self, identified: Sequence[str] = ()) -> list[str]:
        """Joints whose torque, or whose place among the joints, is not to be trusted at any time;
        `*` for all.

        Args:
            identified: bodies whose inertia is not trusted: with them no scale of a torque is
                known.
        """
        kinds = [kind for kind in _WHOLE_LOG if not (identified and kind == "torque_scale")]
        found = [
            joint
            for finding in self.untrustworthy
            if finding.channel.startswith("joint/") and finding.kind in kinds
            for joint in finding.where or ("*",)
        ]
        return list(dict.fromkeys(found))

    def trusted(self, scenario: Scenario, robot: Robot) -> Scenario:
        """The scenario with nothing fitted to rows of joints whose torque is not to be trusted.

        Raises:
            InputError: nothing is left that could be explained.
        """
        recording, untrusted = scenario.recording, self.untrusted_joints(scenario.identify.inertia)
        joints = robot.joint_names if "*" in untrusted else untrusted
        if not robot.has_floating_base and not set(robot.joint_names) - set(joints):
            reasons = "; ".join(finding.text for finding in self.untrustworthy)
            raise InputError(f"nothing is left that could be explained: {reasons}")
        unused = [*recording.unused_rows, *(j for j in joints if j not in recording.unused_rows)]
        return replace(scenario, recording=replace(recording, unused_rows=unused))

    def before(self, outcome: str) -> str:
        """A result with what is not to be trusted of it said first."""
        return " ".join(
            [*(f"Not to be trusted: {finding.text}." for finding in self.untrustworthy), outcome]
        )


def inspect(
    motion: RecordedMotion, noise: Noise | None = None, evidence: Evidence | None = None
) -> Hygiene:
    """Inspects a recording; no findings for one in which all is well.

    Args:
        motion: the log, seen by the model. Works for fixed and floating bases, with and without
            torques.
        noise: what the log shows of the rows' noise, where that is to be said.
        evidence: of this motion, where there is one already.
    """
    evidence = Evidence(motion) if evidence is None else evidence
    findings = [finding for check in _CHECKS for finding in evidence.found_by(check)]
    if noise is not None and (noisy := noise_finding(motion, noise)) is not None:
        findings.append(noisy)
    findings.sort(key=lambda finding: _ORDER.index(finding.severity))
    levels = channel_checks.estimated_noise(motion)
    if noise is not None:
        # What the scenario believes, not what is used instead.
        believed = {level.channel: level.believed for level in noise.channels}
        levels = [replace(n, believed=believed.get(n.channel, n.believed)) for n in levels]
    return Hygiene(tuple(findings), tuple(levels))


def hygiene_json(hygiene: Hygiene) -> dict[str, Any]:
    """Contents of the key `hygiene` in compare.json, diagnosis.json and study.json."""
    return {
        "findings": [
            vars(finding) | {"where": list(finding.where)} for finding in hygiene.findings
        ],
        "noise": [vars(level) for level in hygiene.noise],
    }
