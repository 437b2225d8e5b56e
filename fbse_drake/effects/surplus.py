"""What a model's effects have too much of."""

from collections.abc import Mapping
from dataclasses import replace

from fbse_drake.effects.effect import Effect
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.robot.description import RobotDescription

# What is left of a value by rounding is nothing.
_ROUNDING = 1e-9


def without_surplus(
    effects: Mapping[str, Effect], change: Effect, names: RobotDescription
) -> tuple[dict[str, Effect], Effect | None]:
    """A model's effects less what a change takes away from them.

    Args:
        effects: by name.
        change: of a joint torque effect, values below the bounds of its parameters are taken from
            effects that have the same, see `JointTorqueEffect.shares`.

    Returns:
        The effects; and what the change adds beside them, None for nothing.
    """
    result = dict(effects)
    if not isinstance(change, JointTorqueEffect):
        return result, change
    left = {name: dict(getattr(change, name)) for name, p in change.parameters.items() if p.linear}
    taken = False
    for name, by_joint in left.items():
        low = change.parameters[name].bounds[0]
        # Who reads the scenario refuses joints that the robot has not.
        for joint in [j for j in names.joint_names if by_joint.get(j, low) < low]:
            for key, effect in result.items():
                if not change.shares(name, type(effect)) or by_joint[joint] >= low:
                    continue
                known = effect.resolve(names, key=f"model.effects.{key}").linear_values(name)
                had = float(known[names.joint_names.index(joint)])
                lower = max(low, had + by_joint[joint])
                values = getattr(effect, name) | {joint: lower}
                result[key], taken = replace(effect, **{name: values}), True
                by_joint[joint] += had - lower
                if abs(by_joint[joint]) < _ROUNDING:
                    by_joint[joint] = 0.0
    if taken and not any(value for by_joint in left.values() for value in by_joint.values()):
        return result, None
    return result, replace(change, **left)
