"""The notebooks: they run from top to bottom, some on shorter logs than a reader's, and what is
stored in them is fit to be read."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest
from ipykernel.kernelspec import get_kernel_dict
from jupyter_client import KernelManager
from jupyter_client.kernelspec import KernelSpec
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


class ThisInterpretersKernel(KernelManager):
    """Starts kernels with the interpreter that runs the tests, whatever else the machine calls
    python3."""

    @property
    def kernel_spec(self) -> KernelSpec:
        return KernelSpec(**get_kernel_dict())


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KernelManager]:
    """One kernel for all, for it takes seconds to import what a notebook needs; with settings of
    its own instead of the user's."""
    settings = tmp_path_factory.mktemp("ipython")
    profile = settings / "profile_default"
    profile.mkdir()
    # To find the margins of a picture it is drawn twice.
    (profile / "ipython_kernel_config.py").write_text(
        'get_config().InlineBackend.print_figure_kwargs = {"bbox_inches": None}'
    )
    manager = ThisInterpretersKernel()
    manager.start_kernel(
        extra_arguments=["--HistoryManager.hist_file=:memory:"],
        env={**os.environ, "MPLBACKEND": "Agg", "IPYTHONDIR": str(settings)},
    )
    yield manager
    manager.shutdown_kernel(now=True)


def run(notebook: nbformat.NotebookNode, folder: Path, kernel: KernelManager) -> None:
    """Runs all cells in `folder`, without what ran in the kernel before; fails with the error of
    the first cell that raises."""
    forget = nbformat.v4.new_code_cell(f"%reset_selective -f ^[^_]\n%cd -q {folder}")
    for cells in (nbformat.v4.new_notebook(cells=[forget]), notebook):
        client = NotebookClient(cells, km=kernel, timeout=1200)
        try:
            client.execute()
        except CellExecutionError as error:
            pytest.fail(str(error), pytrace=False)
        finally:
            # Else a thread of it listens for the kernel's heart as long as this process lives.
            client.kc.stop_channels()


def shortened(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """The same on shorter logs: the notebook itself says by what to replace which of its texts."""
    shorter = notebook.metadata.get("fbse", {}).get("shorter", {})
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for long, short in shorter.items():
        assert any(long in cell.source for cell in code), long
        for cell in code:
            cell.source = cell.source.replace(long, short)
    return notebook


def errors(notebook: nbformat.NotebookNode) -> list[str]:
    outputs = [
        output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    ]
    return [
        f"{output.ename}: {output.evalue}" for output in outputs if output.output_type == "error"
    ]


def test_there_are_notebooks():
    assert NOTEBOOKS


@each_notebook
def test_runs(path, kernel):
    notebook = nbformat.read(path, as_version=4)
    needs = notebook.metadata.get("fbse", {})
    if needs.get("needs_data") and not os.environ.get("FBSE_DATA_DIR"):
        pytest.skip("FBSE_DATA_DIR does not name the folder of the recordings that it shows")
    for module in needs.get("needs_modules", []):
        pytest.importorskip(module)
    run(shortened(notebook), path.parent, kernel)
    assert errors(notebook) == []


@each_notebook
def test_stored_content(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    assert errors(notebook) == []
    assert [cell.id for cell in notebook.cells if "pydrake.all" in cell.source] == []
    # What a reader copies is public.
    assert [cell.id for cell in notebook.cells if "from fbse_drake." in cell.source] == []
    assert path.stat().st_size < 1.5e6


def test_kernel_is_this_interpreter(tmp_path, kernel):
    source = "import os, sys\nprint(sys.prefix, os.getcwd(), sep='\\n')"
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    run(notebook, tmp_path, kernel)
    assert notebook.cells[0].outputs[0].text.splitlines() == [sys.prefix, str(tmp_path.resolve())]


def test_error_of_a_cell_is_reported(tmp_path, kernel):
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("1 / 0")])
    with pytest.raises(pytest.fail.Exception, match="ZeroDivisionError"):
        run(notebook, tmp_path, kernel)
    assert errors(notebook) == ["ZeroDivisionError: division by zero"]


def test_a_notebook_knows_nothing_of_the_one_before(tmp_path, kernel):
    for source in ("left_over = 1", "assert 'left_over' not in globals()"):
        cell = nbformat.v4.new_code_cell(source)
        run(nbformat.v4.new_notebook(cells=[cell]), tmp_path, kernel)
