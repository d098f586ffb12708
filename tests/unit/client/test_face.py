"""What the package shows: everything by its own name, nothing by accident, and no more than it needs."""

import inspect
import subprocess
import sys
from pathlib import Path

import l3ps_client


def test_all_names_what_there_is():
    public = {name for name in vars(l3ps_client) if not name.startswith("_")}
    assert public == set(l3ps_client.__all__)
    assert l3ps_client.__all__ == sorted(
        l3ps_client.__all__, key=lambda name: (not name.isupper(), name[0].islower(), name)
    )


def test_private_modules_are_private():
    """An import path that somebody writes down is one that is meant to last."""
    folder = Path(l3ps_client.__file__).parent
    assert {path.stem for path in folder.glob("[!_]*.py")} == {"webhooks"}
    for name in l3ps_client.__all__:
        assert not getattr(getattr(l3ps_client, name), "__module__", "").startswith("l3ps_client._"), name


def test_every_error_is_drawn_in_the_tree():
    from l3ps_client import _errors, webhooks

    kinds = [kind for kind in vars(l3ps_client).values() if inspect.isclass(kind) and issubclass(kind, Exception)]
    assert all(issubclass(kind, l3ps_client.L3psClientError) for kind in kinds)
    for kind in [*kinds, webhooks.BadSignature]:
        assert kind.__name__ in _errors.__doc__


def test_it_imports_nothing_of_the_service():
    code = (
        "import sys, l3ps_client\n"
        "print(sorted({name.partition('.')[0] for name in sys.modules} "
        "& {'l3ps', 'l3ps_platform', 'l3ps_cli', 'numpy', 'pydantic'}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_every_public_method_says_what_it_does():
    groups = {type(value) for value in vars(l3ps_client.Client("http://127.0.0.1:1", "t")).values()}
    for group in groups:
        if group.__module__.startswith("l3ps_client"):
            for name, method in inspect.getmembers(group, inspect.isfunction):
                assert name.startswith("_") or method.__doc__, f"{group.__name__}.{name}"
