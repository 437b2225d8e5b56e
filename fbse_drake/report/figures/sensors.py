"""What the sensors read."""

from matplotlib.figure import Figure

from fbse_drake.log import Log
from fbse_drake.report.figures.kind import figure_kind
from fbse_drake.report.figures.panels import plot, time_grid
from fbse_drake.report.style import PLANNED, add_legend


@figure_kind(
    "IMU",
    "Measured specific force and angular velocity in the IMU's axes. At rest the specific force is "
    "gravity's opposite; a foot that lands shows as a spike.",
    needs=("imu/linear_acceleration", "imu/angular_velocity"),
)
def imu(log: Log) -> Figure:
    """Measured specific force and angular velocity in the IMU frame."""
    figure, grid = time_grid(log, 3, 2, height=6.2)
    columns = (
        ("imu/linear_acceleration", "specific force", "m/s²"),
        ("imu/angular_velocity", "angular velocity", "rad/s"),
    )
    for (channel, title, unit), column in zip(columns, grid.T, strict=True):
        column[0].set_title(title, loc="left", fontsize=10)
        for axes, values, name in zip(column, log[channel].T, "xyz", strict=True):
            plot(axes, log, values, color=PLANNED, linewidth=0.8)
            axes.set_ylabel(f"{name} [{unit}]")
    add_legend(figure)
    return figure
