"""Proposes what the topics of a bag mean for a robot."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from fbse_drake.errors import InputError, located
from fbse_drake.interop.bags import (
    IMU,
    IMU_FIELDS,
    JOINT_STATE,
    JOINT_STATE_FIELDS,
    WRENCH,
    Bag,
    is_bag,
    open_bag,
)
from fbse_drake.interop.mapping import ChannelMap, LogMap
from fbse_drake.robot.description import RobotDescription
from fbse_drake.robot.urdf_model import words

# What sides are called for short, in names of topics.
_SHORT = {"l": "left", "r": "right", "f": "front", "m": "middle", "hind": "rear", "h": "rear"}
_PAIRS = {
    "fl": ("front", "left"),
    "lf": ("front", "left"),
    "fr": ("front", "right"),
    "rf": ("front", "right"),
    "rl": ("rear", "left"),
    "hl": ("rear", "left"),
    "lh": ("rear", "left"),
    "rr": ("rear", "right"),
    "hr": ("rear", "right"),
    "rh": ("rear", "right"),
}


def propose_map(bag: Path, robot: RobotDescription) -> tuple[LogMap, list[str]]:
    """What the topics of a bag mean, as far as their messages and names tell; what they do not, in
    words.

    Args:
        bag: that `open_bag` reads.
        robot: whose joints and feet are looked for.

    Raises:
        InputError: no bag, or one in which no message names a joint of the robot.
    """
    if not is_bag(bag):
        raise InputError(f"{bag}: expected a bag (.mcap, .db3, .bag, or the folder of one)")
    with located(f"{bag}: "), open_bag(bag) as content:
        topics = content.topics()
        channels, recorded, remarks = _joints(content, _of_kind(topics, JOINT_STATE), robot)
        if robot.legs:
            imu, about_imu = _imu(content, _of_kind(topics, IMU), robot)
            feet, about_feet = _feet(_of_kind(topics, WRENCH), robot)
            channels |= imu | feet
            remarks += about_imu + about_feet
        log_map = LogMap(
            joints=list(recorded),
            recorded_joints=[]
            if list(recorded) == list(recorded.values())
            else [*recorded.values()],
            topics=list(dict.fromkeys(channel.topic for channel in channels.values())),
            channels=channels,
        )
        # What convert will do with it.
        content.channels(log_map)
    return log_map, remarks


def _of_kind(topics: dict[str, str], kind: str) -> list[str]:
    return [topic for topic, found in topics.items() if found == kind]


def _joints(
    bag: Bag, topics: Sequence[str], robot: RobotDescription
) -> tuple[dict[str, ChannelMap], dict[str, str], list[str]]:
    """Channels of the joints, the name of each in the bag, and remarks."""
    names = {topic: _same(robot.joint_names, bag.joints(topic)) for topic in topics}
    topic = max(names, key=lambda each: len(names[each]), default="")
    if not names.get(topic):
        there = ", ".join(dict.fromkeys(name for each in topics for name in bag.joints(each)))
        raise InputError(
            f"no message names a joint of the robot (joints: {', '.join(robot.joint_names)}; "
            f"in {JOINT_STATE} messages: {there or 'none'})"
        )
    recorded, first, remarks = names[topic], bag.first(topic), []
    channels = {
        channel: ChannelMap(topic=topic)
        for channel, field in JOINT_STATE_FIELDS.items()
        if first.width(field) == len(bag.joints(topic))
    }
    missing = [name for name in robot.joint_names if name not in recorded]
    if missing:
        remarks.append(f"{topic} does not name {', '.join(missing)}: add what it is called there.")
    if "joint/torque_command" not in channels:
        remarks.append(f"{topic} has no effort: map joint/torque_command, or nothing can be said.")
    others = [each for each, found in names.items() if found and each != topic]
    if others:
        remarks.append(f"Joints are taken from {topic}, not from {', '.join(others)}.")
    return channels, recorded, remarks


def _same(joints: Iterable[str], recorded: Sequence[str]) -> dict[str, str]:
    """What each joint is called in a recording: the same, or the same words in another writing."""

    def key(name: str) -> frozenset[str]:
        return frozenset(words(name)) - {"joint"}

    by_words: dict[frozenset[str], list[str]] = {}
    for name in recorded:
        by_words.setdefault(key(name), []).append(name)
    found = {}
    for joint in joints:
        alike = [joint] if joint in recorded else by_words.get(key(joint), [])
        if len(alike) == 1:
            found[joint] = alike[0]
    return found


def _imu(
    bag: Bag, topics: Sequence[str], robot: RobotDescription
) -> tuple[dict[str, ChannelMap], list[str]]:
    if not topics:
        return {}, [f"No topic has {IMU} messages."]
    frames = {topic: "".join(bag.first(topic).texts.get("header.frame_id", [])) for topic in topics}
    topic = next((each for each, frame in frames.items() if frame == robot.imu), topics[0])
    remarks = []
    others = [each for each in topics if each != topic]
    if others:
        remarks.append(f"The IMU is taken from {topic}, not from {', '.join(others)}.")
    if frames[topic] != robot.imu:
        remarks.append(
            f"{topic} measures in frame {frames[topic] or '(not named)'}, the description's IMU is "
            f"{robot.imu}: check, or turn it (rotation_deg)."
        )
    return {channel: ChannelMap(topic=topic) for channel in IMU_FIELDS}, remarks


def _feet(
    topics: Sequence[str], robot: RobotDescription
) -> tuple[dict[str, ChannelMap], list[str]]:
    channels, remarks, taken = {}, [], set()
    for side in robot.sides:
        fitting = [topic for topic in topics if set(side.split("_")) <= _said(topic)]
        if len(fitting) == 1:
            channels[f"foot/{side}/wrench"] = ChannelMap(topic=fitting[0])
            taken.add(fitting[0])
            continue
        found = ", ".join(fitting) or "none"
        what = "no wrench" if not fitting else "several wrenches"
        remarks.append(
            f"There is {what} of the {side.replace('_', ' ')} foot by its name: {found}."
        )
    left = [topic for topic in topics if topic not in taken]
    if left:
        remarks.append(f"Wrenches that are not mapped: {', '.join(left)}.")
    return channels, remarks


def _said(topic: str) -> set[str]:
    """The words of a topic's name, those for sides in full."""
    said: set[str] = set()
    for word in words(topic):
        said.update(_PAIRS.get(word, (_SHORT.get(word, word),)))
    return said
