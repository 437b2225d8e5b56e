"""Wrong files made of right ones."""

import copy
import io
import json
import re
import zipfile
from typing import Any

import numpy as np
import yaml

# Names that would do something if they were not data.
NAMES = (
    "",
    " ",
    "[bold]x[/bold]",
    "[/]",
    "$\\alpha$",
    "$x_{",
    "<script>alert(1)</script>",
    "{{ 1 }}",
    "{task.total}",
    "%s",
    "a\nb: 1",
    "a\u2028b",
    "\x1b[31mred",
    "../../escape",
    "/dev/null",
    "é\u4e2d\U0001f600",
    "A" * 5000,
    "!Foo",
    "*",
    "nan",
    "all",
)
NUMBERS = (
    0,
    1,
    -1,
    0.5,
    -0.0,
    1e-320,
    1e-9,
    1e9,
    1e19,
    -1e300,
    1e308,
    10**30,
    2**31,
    2**63,
    float("nan"),
    float("inf"),
    -float("inf"),
)
# As they stand in YAML.
SCALARS = (
    *(repr(number).replace("inf", ".inf").replace("nan", ".nan") for number in NUMBERS),
    "1e400",
    "2020-01-01",
    "2020-13-45",
    "2020-01-01 00:00:00",
    "9" * 5000,
    "0x1F",
    "1_000",
    "1:30",
    "~",
    "true",
    "no",
    "!!binary aGk=",
    "!!set {a, b}",
    "!!python/object/apply:os.system [touch RAN]",
    "!!python/name:os.system",
    "!Foo {}",
    "!Foo 3",
    "!Foo [1]",
    "! x",
    "[]",
    "{}",
    "[[]]",
    "{a: 1}",
    "{1: 2}",
    "{? [a] : 1}",
    "{_tag: 5}",
    "{_tag: '!Walk'}",
    "[1, 2, 3]",
    "[" * 50 + "]" * 50,
    "[" * 5000 + "]" * 5000,
    "*unknown",
    "&a [*a]",
    "&a {b: *a}",
)
BOMB = "\n".join(
    [
        "a0: &a0 [x, x, x, x, x, x, x, x, x, x]",
        *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)),
        "m0: &m0 {k0: 1}",
        *(f"m{i}: &m{i} {{<<: [{', '.join([f'*m{i - 1}'] * 10)}]}}" for i in range(1, 12)),
    ]
)


def damaged(content: bytes, random: np.random.Generator) -> bytes:
    """Some bytes wrong, missing, too many, or in another place."""
    data = bytearray(content)
    for _ in range(random.integers(1, 4)):
        size = max(len(data), 1)
        start, length = int(random.integers(size)), int(random.choice([1, 1, 4, 64]))
        kind = random.integers(6)
        if kind == 0:
            data[start : start + length] = random.bytes(length)
        elif kind == 1:
            del data[start : start + length]
        elif kind == 2:
            data[start:start] = random.choice([b"\0", b"\xff", b"\n", b"\xef\xbb\xbf"]) * length
        elif kind == 3:
            del data[start:]
        elif kind == 4:
            data[start:start] = data[: int(random.integers(size))]
        else:
            data[start : start + 1] = bytes(
                [data[start] ^ (1 << random.integers(8))] if data else b""
            )
    return bytes(data)


def value(random: np.random.Generator) -> Any:
    """Any value of JSON, and some that are none."""
    choices: tuple[Any, ...] = (None, True, [], {}, [1, 2], {"a": 1}, [[]], {"": ""}, "1")
    kind = random.integers(4)
    if kind == 0:
        return NUMBERS[random.integers(len(NUMBERS))]
    if kind == 1:
        return NAMES[random.integers(len(NAMES))]
    return copy.deepcopy(choices[random.integers(len(choices))])


def gently_changed(text: str, random: np.random.Generator) -> str:
    """A number for a number, and a name for a name."""
    try:
        number = float(text)
    except ValueError:
        return json.dumps(NAMES[random.integers(len(NAMES))])
    if random.integers(2):
        return repr(number * float(random.choice([-1.0, 0.0, 0.1, 3.0, 1e3, 1e-6, 1e6])))
    return SCALARS[random.integers(len(NUMBERS))]


def changed(tree: Any, random: np.random.Generator) -> Any:
    """A tree with a few places changed: other values, keys that are missing, renamed or too
    many."""
    tree = copy.deepcopy(tree)
    for _ in range(random.integers(1, 3)):
        places = list(_places(tree))
        if not places:
            return value(random)
        holder, key = places[random.integers(len(places))]
        kind = random.integers(8)
        if kind >= 6 and isinstance(holder[key], str | int | float):
            holder[key] = yaml.safe_load(gently_changed(str(holder[key]), random))
        elif kind <= 2:
            holder[key] = value(random)
        elif kind == 3:
            del holder[key]
        elif isinstance(holder, dict):
            name = str(NAMES[random.integers(len(NAMES))])
            holder[name] = holder.pop(key) if kind == 4 else value(random)
        else:
            holder.extend([holder[key]] * int(random.integers(1, 5)))
    return tree


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Holders and keys of everything in a tree."""
    items = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else ()
    )
    return [place for key, item in items for place in [(tree, key), *_places(item)]]


def changed_yaml(text: str, random: np.random.Generator) -> str:
    """YAML with a few nodes changed; its tags stay, unless they are what is changed."""
    kind = random.integers(20)
    if kind == 0:
        return f"{BOMB}\n{text}"
    if kind == 1:
        return SCALARS[random.integers(len(SCALARS))]
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    marks: dict[str, str] = {}
    gentle = random.integers(2)
    for _ in range(random.integers(1, 3)):
        nodes = _nodes(root)
        node = nodes[random.integers(len(nodes))]
        kind = random.integers(7)
        scalar = SCALARS[random.integers(len(SCALARS))]
        if gentle:
            leaves = [leaf for leaf in nodes if isinstance(leaf, yaml.ScalarNode)]
            node = leaves[random.integers(len(leaves))]
            scalar = gently_changed(node.value, random)
        # Written in afterwards: not every text is a node.
        mark = f"MARK{len(marks)}"
        marks[mark] = scalar
        if isinstance(node, yaml.ScalarNode) or kind <= 1:
            node.__class__ = yaml.ScalarNode
            node.tag, node.value, node.style = "tag:yaml.org,2002:str", mark, None
        elif kind == 2:
            node.tag = str(random.choice(["!Walk", "!Squat", "!Foo", "!", "tag:yaml.org,2002:map"]))
        elif kind == 3 and node.value:
            del node.value[random.integers(len(node.value))]
        elif isinstance(node, yaml.MappingNode):
            key = yaml.ScalarNode("tag:yaml.org,2002:str", str(random.choice(NAMES)))
            node.value.append((key, yaml.ScalarNode("tag:yaml.org,2002:str", mark)))
        else:
            node.value.extend(node.value[:1] * int(random.integers(1, 50)))
    try:
        text = yaml.serialize(root, Dumper=yaml.SafeDumper)
    except (yaml.YAMLError, AttributeError, TypeError, ValueError):
        text = text.replace("0", SCALARS[random.integers(len(SCALARS))], 1)
    for mark, scalar in marks.items():
        text = text.replace(mark, scalar)
    return text


def _nodes(node: yaml.Node) -> list[yaml.Node]:
    children = node.value if isinstance(node, yaml.CollectionNode) else []
    if isinstance(node, yaml.MappingNode):
        children = [child for pair in children for child in pair]
    return [node, *(found for child in children for found in _nodes(child))]


def changed_npz(content: bytes, random: np.random.Generator) -> bytes:
    """An npz file with another array, other metadata, or a member that lies about its size."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    kind = random.integers(4)
    names = [name for name in arrays if name != "meta"]
    name = names[random.integers(len(names))]
    if kind == 0 or "meta" not in arrays:
        arrays[name] = _changed_array(arrays[name], random)
    elif kind == 1:
        other = str(NAMES[random.integers(len(NAMES))]).replace("\n", "")
        arrays[other or "empty"] = arrays.pop(name)
    elif kind == 2:
        arrays["meta"] = np.array(json.dumps(changed(json.loads(str(arrays["meta"])), random)))
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    if kind < 3:
        return stream.getvalue()
    return _lying(stream.getvalue(), random)


def read_otherwise(content: bytes, random: np.random.Generator) -> bytes:
    """A log that is whole, of a recorder that was slower, stopped earlier or missed rows; or of a
    channel that is held or nothing but noise."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    rows = len(arrays["time"])
    channels = [name for name, array in arrays.items() if array.ndim and len(array) == rows]
    kind, name = random.integers(5), channels[random.integers(len(channels))]
    if kind < 3:
        missed = random.random(rows) < random.choice([0.02, 0.2])
        start, stop = np.sort(random.integers(rows + 1, size=2))
        step = int(random.choice([2, 10, 50]))
        taken = (
            np.arange(0, rows, step),
            np.arange(start, stop),
            np.flatnonzero(~missed),
        )[kind]
        arrays |= {name: arrays[name][taken] for name in channels}
        if kind == 0:
            meta = json.loads(str(arrays["meta"]))
            arrays["meta"] = np.array(json.dumps(meta | {"period": step * meta["period"]}))
    else:
        noise = random.normal(size=arrays[name].shape)
        arrays[name] = noise if kind == 3 else np.repeat(arrays[name][:1], rows, axis=0)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _changed_array(array: np.ndarray, random: np.random.Generator) -> np.ndarray:
    kind = random.integers(6)
    if kind == 0:
        return array.astype(random.choice(["f4", "i8", "u1", "c16", "?", "U8"]))
    if kind == 1:
        return array[: random.integers(len(array) + 1)] if array.ndim else array[None]
    if kind == 2:
        return array[..., None]
    if kind == 3:
        return np.array(NUMBERS[random.integers(9)])
    array = array.astype(float)
    array[..., :1] = float(NUMBERS[random.integers(len(NUMBERS))])
    return array if kind == 4 else array * float(random.choice([0.0, -1.0, 1e6, 1e150]))


def _lying(content: bytes, random: np.random.Generator) -> bytes:
    """The first member says that its array has another shape."""
    stream, number = io.BytesIO(), random.choice([b"9" * 9, b"9" * 4, b"-1", b"0"])
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream, "w") as new:
        for info in old.infolist():
            data = old.read(info)
            place = data.find(b"'shape': (")
            if place > 0 and info.filename != "meta.npy" and random.integers(2):
                place += len(b"'shape': (")
                data = data[:place] + number + data[place + len(number) :]
            new.writestr(info.filename, data)
    return stream.getvalue()


def damaged_text(content: bytes, random: np.random.Generator) -> bytes:
    """A text with other numbers or names in it, or damaged as any file."""
    if random.integers(3) == 0:
        return damaged(content, random)
    text = content.decode()
    for _ in range(random.integers(1, 3)):
        words = list(re.finditer(r"[\w.+-]+", text))
        word = words[random.integers(len(words))]
        new = str(NUMBERS[random.integers(len(NUMBERS))])
        if random.integers(2):
            new = str(NAMES[random.integers(len(NAMES))])
        text = text[: word.start()] + new + text[word.end() :]
    return text.encode(str(random.choice(["utf-8", "utf-8", "utf-16", "utf-7"])), "replace")
