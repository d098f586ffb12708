"""Tables are read through a sliding window; the window's edge must not show."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l3ps.drivelog import tables

JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**12), 10**12) | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=150, deadline=None)
@given(st.lists(JSON, max_size=6), st.integers(1, 40), st.sampled_from([None, 0, 2]), st.booleans())
def test_any_list_through_any_window(tmp_path_factory, values, window, indent, ascii_only):
    path = tmp_path_factory.mktemp("table") / "t.json"
    path.write_text(json.dumps(values, indent=indent, ensure_ascii=ascii_only) + "\n", encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "_WINDOW", window)
        assert list(tables.stream(path)) == values


@settings(max_examples=100, deadline=None)
@given(st.lists(JSON, min_size=1, max_size=4), st.data(), st.integers(1, 40))
def test_a_cut_table_is_an_error_never_a_shorter_table(tmp_path_factory, values, data, window):
    text = json.dumps(values)
    path = tmp_path_factory.mktemp("table") / "t.json"
    path.write_text(text[: data.draw(st.integers(0, len(text) - 1))], encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "_WINDOW", window)
        with pytest.raises(tables.TableError):
            list(tables.stream(path))


def test_a_row_of_absurd_length_is_not_gathered_in_memory(tmp_path, monkeypatch):
    path = tmp_path / "t.json"
    path.write_text('["' + "x" * 10_000)
    monkeypatch.setattr(tables, "_WINDOW", 100)
    monkeypatch.setattr(tables, "_LONGEST_ROW", 1000)
    with pytest.raises(tables.TableError, match="not valid JSON"):
        list(tables.stream(path))
