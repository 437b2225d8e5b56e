"""Can a recording be believed? What is wrong with its clocks, channels, units and frames, before anybody looks for physics in it.

A log that makes the equation of motion meaningless is refused (`sanity.check_sensors`). What is found here does not stop a diagnosis, but
says what of it is not to be believed.
"""

from dataclasses import dataclass
from typing import Any

from fbse_drake.discrepancy import channel_checks, model_checks
from fbse_drake.discrepancy.evidence import Evidence, HygieneFinding, NoiseLevel
from fbse_drake.discrepancy.residual import RecordedMotion

_CHECKS = (*channel_checks.CHECKS, *model_checks.CHECKS)
_ORDER = ("untrustworthy", "warning", "note")


@dataclass(frozen=True)
class Hygiene:
    """Everything that is remarkable about a recording, worst first, and the noise of its channels."""

    findings: tuple[HygieneFinding, ...] = ()
    noise: tuple[NoiseLevel, ...] = ()

    @property
    def untrustworthy(self) -> list[HygieneFinding]:
        return [finding for finding in self.findings if finding.severity == "untrustworthy"]

    def before(self, outcome: str) -> str:
        """A result with what is not to be trusted of it said first."""
        return " ".join(
            [*(f"Not to be trusted: {finding.text}." for finding in self.untrustworthy), outcome]
        )


def inspect(motion: RecordedMotion) -> Hygiene:
    """Inspects a recording; no findings for one in which all is well.

    Args:
        motion: the log, seen by the model. Works for fixed and floating bases, with and without torques.
    """
    evidence = Evidence(motion)
    findings = sorted(
        (finding for check in _CHECKS for finding in check(evidence)),
        key=lambda finding: _ORDER.index(finding.severity),
    )
    return Hygiene(tuple(findings), tuple(channel_checks.estimated_noise(motion)))


def hygiene_json(hygiene: Hygiene) -> dict[str, Any]:
    """Contents of the key `hygiene` in compare.json, diagnosis.json and study.json."""
    return {
        "findings": [
            vars(finding) | {"where": list(finding.where)} for finding in hygiene.findings
        ],
        "noise": [vars(level) for level in hygiene.noise],
    }
