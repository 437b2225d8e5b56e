"""Logs as pandas and xarray objects."""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.signals import channel_kind

if TYPE_CHECKING:
    import pandas
    import xarray


def to_pandas(log: Log) -> "pandas.DataFrame":
    """One row per sample, indexed by `time` [s]; a column for each number, as
    `joint/position/left_knee` or `imu/angular_velocity[0]`. Units by column are in `attrs`."""
    pandas = _needed("pandas")
    columns, units = {}, {}
    for name, values in log.items():
        if name == "time":
            continue
        flat = values.reshape(len(log.time), -1)
        for k, column in enumerate(_columns(log, name)):
            columns[column], units[column] = flat[:, k], log.unit(name)
    frame = pandas.DataFrame(columns, index=pandas.Index(log.time, name="time"))
    frame.attrs["units"] = units
    return frame


def to_xarray(log: Log) -> "xarray.Dataset":
    """One variable per channel with its unit in `attrs`; dimensions are `time` [s], `joint` (by
    name) and, for each channel with further ones, its own."""
    variables = {}
    for name, values in log.items():
        if name == "time":
            continue
        _, shape = channel_kind(name)
        sizes = (f"{name}_{axis}" for axis in range(len(shape)))
        dims = ["joint" if size == "n" else own for size, own in zip(shape, sizes, strict=True)]
        variables[name] = (("time", *dims), values, {"units": log.unit(name)})
    data: xarray.Dataset = _needed("xarray").Dataset(
        variables, {"time": log.time, "joint": log.joints}
    )
    return data


def _columns(log: Log, name: str) -> list[str]:
    """Names of the numbers of one sample."""
    _, shape = channel_kind(name)
    if not shape:
        return [name]
    if shape == ("n",):
        return [f"{name}/{joint}" for joint in log.joints]
    return [f"{name}[{k}]" for k in range(log[name][0].size)]


def _needed(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise InputError(f"this needs {name}: pip install 'fbse_drake[data]'") from None
