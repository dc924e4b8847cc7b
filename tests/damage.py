"""Ways to damage a file: hypothesis' strategies, which give functions from the file's bytes to damaged ones."""

import io
import json
import re
from functools import partial

import numpy as np
import torch
import yaml
from hypothesis import strategies as st

WHERE = st.floats(0, 1, exclude_max=True)
"""A place in a file, an array or a list, as a share of its length."""

JUNK = (
    None, True, 0, -1, 5, 2**63, 10**400, 0.5, -7.25, 1e308, -1e30, "", "x", "\x1b[31m", "[/bold]",
    "<script>alert(1)</script>", "\ud800", "x" * 5000,
    [], [1], ["x"], {}, {"x": 1}, [[[[]]]],
)  # fmt: skip
"""Entries of JSON, YAML and checkpoints."""
JUNK_WORDS = (
    "nan", "inf", "-1", "1e300", "0", "", "x", "1 2", '"', "\x00", "\x9b", "../../etc/passwd", "100000000",
    "1" * 5000, "[" * 2000,
)  # fmt: skip
NUMBERS = (np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-300, -1.0, 0.0, 2.0**63)
TYPES = (
    "u1", "u4", "u8", ">u4", ">i8", "i2", "f2", ">f4", ">f8", "longdouble", "complex64", "U3", "S3",
    "bool", "M8[s]",
)  # fmt: skip
MANY = 20_000
"""Times that an entry or a line is repeated."""


def damages(kind):
    """Ways to damage a file of that kind; any file may also be damaged byte by byte."""
    own = {
        "npz": _arrays(),
        "json": _entries(json.loads, _as_json),
        "yaml": _entries(yaml.safe_load, _as_yaml),
        "checkpoint": _entries(_load_checkpoint, _as_checkpoint),
        "text": _words(),
    }
    return st.one_of(own[kind], _bytes()) if kind in own else _bytes()


def _damage(function, **arguments):
    """Calls of a function ``(whole, **arguments)``; the arguments are strategies."""
    return st.builds(partial, st.just(function), **arguments)


# Bytes -----------------------------------------------------------------------------------------------------------------------------------


def _bytes():
    place_and_value = st.tuples(WHERE, st.integers(0, 255))
    flips = _damage(_flip, places=st.lists(place_and_value, min_size=1, max_size=8))
    return st.one_of(
        _damage(_cut, at=WHERE),
        _damage(_insert, at=WHERE, text=st.binary(min_size=1, max_size=40)),
        _damage(_repeat_end, at=WHERE),
        flips,
        flips,
    )


def _cut(whole, at):
    return whole[: int(at * len(whole))]


def _insert(whole, at, text):
    place = int(at * len(whole))
    return whole[:place] + text + whole[place:]


def _repeat_end(whole, at):
    return whole + whole[int(at * len(whole)) :]


def _flip(whole, places):
    content = bytearray(whole)
    for at, value in places:
        content[int(at * len(content))] = value
    return bytes(content)


# Words of a text -------------------------------------------------------------------------------------------------------------------------


def _words():
    """Nine of ten times one number or quoted text becomes junk, once a line becomes many."""
    replaced = _damage(_replace_word, at=WHERE, text=st.sampled_from(JUNK_WORDS))
    return st.one_of(*[replaced] * 9, _damage(_repeat_line, at=WHERE))


def _replace_word(whole, at, text):
    content = whole.decode("latin-1")
    words = list(re.finditer(r"[-+.\w]+", content))
    if not words:
        return whole
    word = words[int(at * len(words))]
    return (content[: word.start()] + text + content[word.end() :]).encode("latin-1")


def _repeat_line(whole, at):
    lines = whole.splitlines(keepends=True)
    if lines:
        lines[int(at * len(lines))] *= MANY
    return b"".join(lines)


# Arrays ----------------------------------------------------------------------------------------------------------------------------------


def _arrays():
    """Changes one array of an npz file: its numbers, its type, its shape, whether it is there."""
    hows = [
        "number",
        "number",
        "all",
        "type",
        "type",
        "shape",
        "text",
        "drop",
        "swap",
        "bomb",
        "grow",
    ]
    return _damage(
        _change_array,
        at=WHERE,
        how=st.sampled_from(hows),
        number=st.sampled_from(NUMBERS),
        kind=st.sampled_from(TYPES),
        place=WHERE,
    )


def _change_array(whole, at, how, number, kind, place):
    arrays = dict(np.load(io.BytesIO(whole)))
    names = sorted(arrays)
    name = names[int(at * len(names))]
    if how == "drop":
        del arrays[name]
    elif how == "bomb":
        arrays["x"] = np.zeros(1_000_000, dtype=np.uint8)
    else:
        try:
            with np.errstate(all="ignore"):
                arrays[name] = _changed(arrays[name], how, number, kind, place)
        except (ValueError, TypeError, OverflowError):  # such as a text that is to be a number
            return _cut(whole, place)
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def _changed(array, how, number, kind, place):
    """The array, changed in one of the ways that apply to it."""
    is_number = array.dtype.kind in "fiu" and array.size > 0
    is_text = array.dtype.kind == "U"
    if how == "number" and is_number:
        array = array.copy()
        array.ravel()[int(place * array.size)] = np.array(number).astype(array.dtype)
    elif how == "all" and array.dtype.kind == "f":
        array = np.full(array.shape, number)
    elif how == "all":
        array = np.zeros_like(array)
    elif how == "type":
        array = array.astype(kind)
    elif how == "shape" and place < 0.3:
        array = array[..., None]
    elif how == "shape":
        array = array.reshape(-1)[: int(place * array.size)]
    elif how == "text":
        array = np.full(array.shape, "\x1b[31m[/bold]")
    elif how == "grow" and array.ndim and not is_text:
        array = np.tile(array, (1000,) + (1,) * (array.ndim - 1))
    elif how == "swap" and array.ndim:
        array = array[::-1]
    return array


# Entries of nested objects and lists -----------------------------------------------------------------------------------------------------


def _entries(load, dump):
    """Replaces, removes or adds an entry anywhere in nested objects and lists."""
    hows = ["replace", "replace", "replace", "drop", "add", "grow"]
    return _damage(
        _change_entry,
        load=st.just(load),
        dump=st.just(dump),
        path=st.lists(WHERE, min_size=1, max_size=6),
        how=st.sampled_from(hows),
        junk=st.sampled_from(JUNK),
    )


def _change_entry(whole, load, dump, path, how, junk):
    data = load(whole)
    node = data
    for at in path:
        key = _key_at(node, at)
        if key is None or not isinstance(node[key], dict | list) or not node[key]:
            break
        node = node[key]
    key = _key_at(node, path[-1])
    if how == "add" and isinstance(node, dict):
        node["later"] = junk
    elif key is not None:
        if how == "drop":
            del node[key]
        elif how == "grow":
            node[key] = [node[key]] * MANY
        else:
            node[key] = junk
    return dump(data)


def _key_at(node, at):
    keys = list(node) if isinstance(node, dict) else range(len(node))
    return keys[int(at * len(keys))] if keys else None


def _as_json(data):
    return json.dumps(data).encode()


def _as_yaml(data):
    return yaml.dump(data).encode("utf-8", "surrogatepass")


def _load_checkpoint(whole):
    return torch.load(io.BytesIO(whole), weights_only=True)


def _as_checkpoint(data):
    out = io.BytesIO()
    torch.save(data, out)
    return out.getvalue()
