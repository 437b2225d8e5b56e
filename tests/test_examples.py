"""The examples in docstrings of public names do what they say."""

import doctest

import pytest

import fbse_drake

# What a newcomer meets first.
_SHOWN = {
    "Effect",
    "JointTorqueEffect",
    "Log",
    "Parameter",
    "Scenario",
    "compare",
    "diagnose",
    "load_scenario",
    "simulate",
}


def with_examples() -> list[str]:
    documented = ((name, getattr(fbse_drake, name).__doc__) for name in fbse_drake.__all__)
    return [name for name, text in documented if ">>>" in (text or "")]


def test_what_comes_first_has_examples():
    assert set(with_examples()) >= _SHOWN


@pytest.mark.parametrize("name", with_examples())
def test_an_example_gives_what_it_says(name: str):
    text = getattr(fbse_drake, name).__doc__
    example = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    report: list[str] = []
    failed, tried = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(
        example, out=report.append
    )
    assert tried
    assert failed == 0, "".join(report)
