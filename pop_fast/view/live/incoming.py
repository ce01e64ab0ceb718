"""What a browser sends to the viewer, checked as a file is before viser and we read it."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from pop_fast.errors import PopError

# raises PopError of a value that a control cannot have
Rule = Callable[[Any], None]

_LARGEST: Final = 1e9
_LONGEST_SIDE: Final = 16_384
# a browser counts in steps, and rounds their sum
_SLACK: Final = 1e-3
_VECTORS: Final = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
# the stock page says these too, and nobody here listens
_IDLE: Final = ("FileTransferPartAck", "GuiButtonHoldMessage")


def passed_on(data: Any, rules: Mapping[str, Rule]) -> bool:
    """Tell whether a message is for viser to read.

    Args:
        data: as it came.
        rules: of the controls, by viser's names of them.

    Raises:
        PopError: it is none that the viewer's page sends; says what is wrong with it.
    """
    message = _decoded(data)
    kind = message.pop("type", None)
    if kind in _IDLE:
        return False
    known = {"ViewerCameraMessage": _check_camera, "SceneNodeClickMessage": _check_click}
    if kind == "GuiUpdateMessage":
        _check_update(message, rules)
    elif kind in known:
        known[kind](message)
    else:
        raise PopError(f"a browser asked for {_short(kind)}, which the viewer does not do")
    return True


def one_of(options: Sequence[str]) -> Rule:
    """Make the rule of a list to choose from, or of a row of buttons."""

    def check(value: Any) -> None:
        if not isinstance(value, str) or value not in options:
            raise PopError(f"a browser chose {_short(value)}, which was not offered")

    return check


def number(low: float, high: float) -> Rule:
    """Make the rule of a slider."""

    def check(value: Any) -> None:
        if not _is_number(value) or not low - _SLACK <= value <= high + _SLACK:
            raise PopError(f"a browser set a slider to {_short(value)}; it goes from {low:g} to {high:g}")

    return check


def interval(low: float, high: float) -> Rule:
    """Make the rule of a slider with two ends."""

    def check(value: Any) -> None:
        whole = isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))
        if not whole or not low - _SLACK <= value[0] <= value[1] <= high + _SLACK:
            raise PopError(f"a browser set a slider to {_short(value)}; its two ends lie from {low:g} to {high:g}")

    return check


def flag(value: Any) -> None:
    """Check what a box or a button is set to: the rule of both."""
    if not isinstance(value, bool):
        raise PopError(f"a browser set a box to {_short(value)}")


def _decoded(data: Any) -> dict[str, Any]:
    try:
        message = importlib.import_module("msgspec.msgpack").decode(data)
    # text instead of bytes, a broken message, one that is too deep
    except (TypeError, ValueError, RecursionError) as error:
        raise PopError(f"a browser sent what is no message ({error})") from error
    if not isinstance(message, dict):
        raise PopError("a browser sent what is no message")
    return message


def _check_camera(message: dict[str, Any]) -> None:
    if message.keys() != {*_VECTORS, "fov", "near", "far", "image_height", "image_width"}:
        raise PopError("a browser sent a camera with other fields than a camera has")
    for name, length in _VECTORS.items():
        _check_vector(message[name], length, f"a camera with {name}")
    norm = math.hypot(*message["wxyz"])
    if abs(norm - 1.0) > 1e-3:
        raise PopError(f"a browser sent a camera whose quaternion wxyz has length {norm:g}; it must be 1")
    for name in ("near", "far"):
        if not _is_number(message[name]) or message[name] <= 0.0:
            raise PopError(f"a browser sent a camera with {name} {_short(message[name])}; it must be positive")
    if not _is_number(message["fov"]) or not 0.005 < message["fov"] < 3.1:
        raise PopError(f"a browser sent a camera with fov {_short(message['fov'])}; it must be in (0.005, 3.1)")
    for name in ("image_height", "image_width"):
        value = message[name]
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _LONGEST_SIDE:
            raise PopError(f"a browser sent a camera with {name} {_short(value)}; it must be 0 to {_LONGEST_SIDE}")


def _check_click(message: dict[str, Any]) -> None:
    """Check a click on a training camera."""
    fields = {"name", "instance_index", "ray_origin", "ray_direction", "screen_pos", "modifier", "owner"}
    if not message.keys() <= fields or not message.keys() >= fields - {"owner"}:
        raise PopError("a browser sent a click with other fields than a click has")
    _check_vector(message["ray_origin"], 3, "a click with ray_origin")
    _check_vector(message["ray_direction"], 3, "a click with ray_direction")
    _check_vector(message["screen_pos"], 2, "a click with screen_pos")
    for name in ("name", "instance_index", "modifier", "owner"):
        value = message.get(name)
        whole = isinstance(value, int) if name == "instance_index" else isinstance(value, str) and len(value) < 256
        if not whole and (value is not None or name == "name"):
            raise PopError(f"a browser sent a click with {name} {_short(value)}")


def _check_update(message: dict[str, Any], rules: Mapping[str, Rule]) -> None:
    """Check a value that a control was set to."""
    control, updates = message.get("uuid"), message.get("updates")
    if message.keys() != {"uuid", "updates"} or not isinstance(control, str) or control not in rules:
        raise PopError(f"a browser set {_short(control)}, which is no control of the viewer")
    # viser would set any field of the control that is named here
    if not isinstance(updates, dict) or updates.keys() != {"value"}:
        raise PopError("a browser set more of a control than its value")
    rules[control](updates["value"])


def _check_vector(value: Any, length: int, what: str) -> None:
    if not isinstance(value, list) or len(value) != length or not all(map(_is_number, value)):
        raise PopError(f"a browser sent {what} {_short(value)}; it must be {length} finite numbers")


def _is_number(value: Any) -> bool:
    """Tell whether it is a number that single precision holds, squared too."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
