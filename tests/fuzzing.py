"""Hypothesis strategies that damage valid files, for tests of their readers.

Examples are derived from the test, not drawn at random: every run tries the same ones.
"""

import json

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

SHORT = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

_NUMBERS = [0, -1, 1, 2**31, 2**63, -(10**30), 10**400, 0.5, 1e-300, 1e300, float("nan"), float("inf")]
VALUES = st.sampled_from(
    [None, True, False, "", "mug", "\0", "../../etc/passwd", "x" * 300, [], {}, [[]], [None], *_NUMBERS]
)


@st.composite
def damaged_bytes(draw, content: bytes) -> bytes:
    """Cut, overwrite, repeat, insert or swap parts of a file, up to four times."""
    for _ in range(draw(st.integers(1, 4))):
        first = draw(st.integers(0, len(content)))
        last = min(first + draw(st.integers(0, 40)), len(content))
        part = content[first:last]
        change = draw(st.sampled_from(["cut", "drop", "overwrite", "repeat", "insert", "digits"]))
        if change == "cut":
            content = content[:first]
        elif change == "drop":
            content = content[:first] + content[last:]
        elif change == "overwrite":
            new = draw(st.binary(min_size=len(part), max_size=len(part)))
            content = content[:first] + new + content[last:]
        elif change == "repeat":
            content = content[:first] + part * draw(st.integers(2, 50)) + content[last:]
        elif change == "insert":
            content = content[:first] + draw(st.binary(max_size=20)) + content[first:]
        else:
            content = content[:first] + b"9" * draw(st.sampled_from([1, 20, 400, 5000])) + content[first:]
    return content


@st.composite
def damaged_json(draw, value):
    """Replace, delete or add one value somewhere in a JSON document."""
    document = json.loads(json.dumps(value))
    if draw(st.integers(0, 9)) == 0 or not document:
        return draw(VALUES)
    place = document
    while True:
        keys = list(place) if isinstance(place, dict) else range(len(place))
        key = draw(st.sampled_from(list(keys)))
        child = place[key]
        if not (isinstance(child, dict | list) and child) or draw(st.integers(0, 3)) == 0:
            break
        place = child
    change = draw(st.sampled_from(["replace", "replace", "replace", "delete", "double"]))
    if change == "replace":
        place[key] = draw(VALUES)
    elif change == "delete":
        del place[key]
    elif isinstance(place, list):
        place.append(child)
    else:
        place[f"{key}2"] = child
    return document
