"""Forces on the feet."""

import numpy as np
from matplotlib.figure import Figure

from fbse_drake.log import Log
from fbse_drake.report.figures.kind import figure_kind
from fbse_drake.report.figures.panels import name_phases, plot, side_color, time_grid
from fbse_drake.report.metrics import has_feet
from fbse_drake.report.style import INK, PLANNED

# The direction of a foot's force means little below this share of the feet's mean load.
_LOADED_SHARE = 0.05


@figure_kind(
    "Foot forces",
    "Measured vertical load of each foot and of all feet together, how much of the friction cone "
    "the feet use (tangential over vertical force), and the vertical force on every pad, or the "
    "centre of pressure under a six-axis sensor.",
    where=lambda log: feels_feet(log) and not _hangs(log),
)
def foot_forces(log: Log) -> Figure:
    """Measured load of the feet: vertical, tangential over vertical, and vertical on each pad, or
    where it acts."""
    figure, grid = time_grid(log, 2 + len(log.sides), 1, height=5 + 1.9 * len(log.sides))
    vertical, ratio, *pad_axes = grid.flat
    force = {side: foot_force(log, side) for side in log.sides}
    total = np.sum([force[side][:, 2] for side in log.sides], axis=0)
    weight = total.mean()
    plot(vertical, log, total, color=INK, linewidth=0.8, alpha=0.6, label="all feet")
    for side, width in zip(log.sides, np.linspace(1.8, 1, len(log.sides)), strict=True):
        plot(
            vertical,
            log,
            force[side][:, 2],
            color=side_color(log, side),
            linewidth=width,
            label=f"{side} foot",
        )
        loaded = force[side][:, 2] > _LOADED_SHARE * weight
        used = np.full(len(total), np.nan)
        used[loaded] = np.linalg.norm(force[side][loaded, :2], axis=1) / force[side][loaded, 2]
        plot(ratio, log, used, color=side_color(log, side))
    vertical.axhline(weight, color=PLANNED, linestyle="--", linewidth=0.9, label="mean of all feet")
    vertical.set_ylabel("vertical [N]")
    ratio.set_ylabel("tangential / vertical [1]")
    ratio.set_ylim(0, max(0.1, ratio.get_ylim()[1]))
    for side, axes in zip(log.sides, pad_axes, strict=True):
        if f"foot/{side}/pad_force" not in log:
            pressure = np.where(
                force[side][:, 2:] > _LOADED_SHARE * weight, centre_of_pressure(log, side), np.nan
            )
            for values, name, shade in zip(
                pressure.T, ("ahead", "to the left"), (1, 0.5), strict=True
            ):
                plot(
                    axes,
                    log,
                    1e3 * values,
                    color=side_color(log, side),
                    alpha=shade,
                    linewidth=1.0,
                    label=name,
                )
            axes.set_ylabel(f"{side} pressure, centre [mm]")
            continue
        pads = log[f"foot/{side}/pad_force"][:, :, 2].T
        for pad, (values, shade) in enumerate(
            zip(pads, np.linspace(1, 0.3, len(pads)), strict=True), start=1
        ):
            plot(
                axes,
                log,
                values,
                color=side_color(log, side),
                alpha=shade,
                linewidth=1.0,
                label=f"pad {pad}",
            )
        axes.set_ylabel(f"{side} pads, vertical [N]")
    for axes in (vertical, *pad_axes):
        axes.legend(
            handles=axes.get_lines(), loc="center left", bbox_to_anchor=(1, 0.5), frameon=False
        )
    name_phases(vertical, log)
    return figure


def _hangs(log: Log) -> bool:
    """Whether no foot ever touches the ground; known only from truth."""
    return has_feet(log, "truth/foot/{}/pad_force") and not any(
        log[f"truth/foot/{side}/pad_force"].any() for side in log.sides
    )


def feels_feet(log: Log) -> bool:
    """Whether the forces on all feet were measured, by pads or by six-axis sensors."""
    return bool(log.sides) and all(
        f"foot/{side}/pad_force" in log or f"foot/{side}/wrench" in log for side in log.sides
    )


def foot_force(log: Log, side: str) -> np.ndarray:
    """Measured force on a foot, in its sole frame, (N, 3) [N]."""
    pads = f"foot/{side}/pad_force"
    return log[pads].sum(axis=1) if pads in log else log[f"foot/{side}/wrench"][:, 3:]


def centre_of_pressure(log: Log, side: str) -> np.ndarray:
    """Where the force under a six-axis sensor acts, in the sole frame, (N, 2) [m]; the sole's
    origin where there is hardly any."""
    m_x, m_y, _, _, _, f_z = log[f"foot/{side}/wrench"].T
    return np.stack([-m_y, m_x], axis=1) / np.where(f_z > 1.0, f_z, np.inf)[:, None]
