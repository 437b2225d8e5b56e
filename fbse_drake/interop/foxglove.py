"""A layout for Foxglove, which shows an exported log: the robot in 3D, joints, forces of the
feet."""

from typing import Any

from fbse_drake.log import Log

# Channels that are drawn by joint, if they are there, and their plots' titles.
_BY_JOINT = {
    "truth/joint/friction_torque": "friction [Nm]",
    "estimate/joint/friction_torque": "estimated friction [Nm]",
}


def foxglove_layout(log: Log, *, has_frames: bool) -> dict[str, Any]:
    """The layout of a file that `write_mcap` makes of a log.

    Args:
        has_frames: are the robot's frames and its description in it?
    """
    panels: dict[str, Any] = {}
    if has_frames:
        panels["3D!robot"] = {
            "followTf": "world",
            "layers": {
                "robot": {
                    "layerId": "foxglove.Urdf",
                    "instanceId": "robot",
                    "label": "robot",
                    "sourceType": "topic",
                    "topic": "/robot_description",
                    "visible": True,
                }
            },
        }
    count = len(log.joints)
    for name, title in (("position", "position [rad]"), ("effort", "torque command [Nm]")):
        channel = "joint/torque_command" if name == "effort" else "joint/position"
        if channel in log:
            paths = [f"/joint_states.{name}[{k}]" for k in range(count)]
            panels[f"Plot!{name}"] = _plot(title, paths, log.joints)
    for number, (name, title) in enumerate(_BY_JOINT.items()):
        if name in log:
            paths = [f"/{name}.data[{k}]" for k in range(count)]
            panels[f"Plot!{number}"] = _plot(title, paths, log.joints)
    feet = [side for side in log.sides if _has_force(log, side)]
    if feet:
        paths = [f"/foot/{side}/wrench.wrench.force.z" for side in feet]
        panels["Plot!feet"] = _plot("vertical force on the feet [N]", paths, feet)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _arranged(list(panels)),
    }


def _has_force(log: Log, side: str) -> bool:
    return any(f"foot/{side}/{kind}" in log for kind in ("pad_force", "wrench"))


def _plot(title: str, paths: list[str], labels: list[str]) -> dict[str, Any]:
    lines = [
        {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}
        for path, label in zip(paths, labels, strict=True)
    ]
    return {
        "title": title,
        "paths": lines,
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
    }


def _arranged(panels: list[str]) -> Any:
    """The first panel on the left, the others below each other on the right."""
    if len(panels) == 1:
        return panels[0]
    first, *rest = panels
    column: Any = rest[-1]
    for number, panel in enumerate(reversed(rest[:-1]), start=2):
        share = 100.0 / number
        column = {"direction": "column", "first": panel, "second": column, "splitPercentage": share}
    return {"direction": "row", "first": first, "second": column, "splitPercentage": 50}
