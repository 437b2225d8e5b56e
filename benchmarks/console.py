"""Tables on the console."""

from rich.console import Console
from rich.table import Table as ConsoleTable

from fbse_drake.report.html import Table, number


def print_table(console: Console, title: str, table: Table) -> None:
    """Prints a table, texts to the left and numbers to the right."""
    shown = ConsoleTable(title=title, title_justify="left")
    first = table.rows[0] if table.rows else [""] * len(table.header)
    for head, cell in zip(table.header, first, strict=True):
        shown.add_column(head, justify="left" if isinstance(cell, str) else "right")
    for row in table.rows:
        shown.add_row(
            *(str(cell) if isinstance(cell, (str, int)) else number(float(cell)) for cell in row)
        )
    console.print(shown)
