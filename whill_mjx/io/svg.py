"""Small charts as inline SVG, for pages that open anywhere without a plotting library."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

MAX_POINTS = 400  # of a drawn line; more cannot be seen
COLOURS = {"measured": "#111111", "ideal": "#9a9a9a", "initial": "#e08214", "fitted": "#1f6fb4"}
DASHES = {"measured": "", "ideal": "2 3", "initial": "6 3", "fitted": ""}
PALETTE = ("#1f6fb4", "#e08214", "#2a9d4a", "#b2182b", "#6a51a3", "#8c6d31", "#111111", "#9a9a9a")
LEFT, RIGHT, TOP, BOTTOM = 52.0, 10.0, 22.0, 36.0  # margins [px]
Scale = Callable[[float], np.ndarray]


@dataclass(frozen=True)
class Line:
    """One line of a chart; points that are not finite interrupt it."""

    x: np.ndarray  # (T,)
    y: np.ndarray  # (T,)
    label: str = ""
    colour: str = PALETTE[0]
    dash: str = ""
    width: float = 1.4
    markers: bool = False


def replay_line(x: np.ndarray, y: np.ndarray, replay: str) -> Line:
    """Line in the colour of "measured", "ideal", "initial" or "fitted", without a label of its own."""
    return Line(x, y, "", COLOURS[replay], DASHES[replay], 2.2 if replay == "measured" else 1.3)


@dataclass(frozen=True)
class Axes:
    """How lines are drawn."""

    width: int = 360
    height: int = 270
    equal: bool = False
    """One metre is as long across as up."""
    smallest: float = 0.0
    """Least span of both axes, so that noise does not fill the chart."""
    band: tuple[float, float] | None = None
    """Shaded range of y."""
    covers: tuple[float, ...] = ()
    """Values of y that are always inside, such as 0 and 1 of a share."""


def line_chart(
    lines: Sequence[Line], x_label: str, y_label: str, title: str = "", axes: Axes = Axes(),  # noqa: B008
) -> str:  # fmt: skip
    """SVG of lines over one another."""
    width, height, band = axes.width, axes.height, axes.band
    drawn = [line for line in lines if len(line.x)]
    xs = [line.x[np.isfinite(line.x) & np.isfinite(line.y)] for line in drawn]
    ys = [line.y[np.isfinite(line.x) & np.isfinite(line.y)] for line in drawn]
    x = np.concatenate([*xs, []])
    y = np.concatenate([*ys, list(band or []), list(axes.covers)])
    if not len(x):
        return f"<p>{escape(title)}: nothing to show.</p>"
    x_range, y_range = _range(x, axes.smallest), _range(y, axes.smallest)
    inner_width, inner_height = width - LEFT - RIGHT, height - TOP - BOTTOM
    if axes.equal:
        scale = max((x_range[1] - x_range[0]) / inner_width, (y_range[1] - y_range[0]) / inner_height)
        x_range, y_range = _centred(x_range, scale * inner_width), _centred(y_range, scale * inner_height)

    def across(value: np.ndarray | float) -> np.ndarray:
        return LEFT + (np.asarray(value) - x_range[0]) / (x_range[1] - x_range[0]) * inner_width

    def down(value: np.ndarray | float) -> np.ndarray:
        return TOP + (y_range[1] - np.asarray(value)) / (y_range[1] - y_range[0]) * inner_height

    parts = [_frame(width, height, title, x_label, y_label)]
    if band is not None:
        top, bottom = float(down(band[1])), float(down(band[0]))
        parts.append(f'<rect class="band" x="{LEFT:.1f}" y="{top:.1f}" width="{inner_width:.1f}" '
                     f'height="{max(bottom - top, 0.5):.1f}"/>')
    parts += _ticks(x_range, y_range, across, down, width, height)
    for line in drawn:
        parts.append(_polyline(across(line.x), down(line.y), line))
    parts += _legend([(line.label, line.colour, line.dash) for line in drawn if line.label], width)
    return _svg(width, height, parts)


def bar_chart(
    names: Sequence[str], series: dict[str, Sequence[float]], y_label: str, title: str = "", *, log_y: bool = True,
    width: int = 760,
) -> str:
    """SVG of grouped bars: one group per name, one bar per series; values that are not finite leave a hole."""
    height, colours = 300, {**{name: PALETTE[k % len(PALETTE)] for k, name in enumerate(series)}, **COLOURS}
    values = np.array([list(one) for one in series.values()], float)  # (S, N)
    known = values[np.isfinite(values) & ((values > 0) | (not log_y))]
    if not len(known):
        return f"<p>{escape(title)}: nothing to show.</p>"
    longest = max(len(name) for name in names)
    bottom = BOTTOM + min(5.2 * longest, 120.0)
    inner_width, inner_height = width - LEFT - RIGHT, height - TOP - bottom + 20
    low, high = (float(np.log10(known.min())) - 0.15, float(np.log10(known.max())) + 0.1) if log_y else (
        min(0.0, float(known.min())), float(known.max()) * 1.05)
    high = high if high > low else low + 1.0  # all bars are 0

    def down(value: float) -> float:
        return TOP + (high - value) / (high - low) * inner_height

    parts = [f'<text class="title" x="{LEFT}" y="13">{escape(title)}</text>',
             f'<text class="label" transform="translate(11 {TOP + inner_height / 2:.0f}) rotate(-90)" '
             f'text-anchor="middle">{escape(y_label)}</text>']
    for tick in _log_ticks(low, high) if log_y else _nice_ticks(low, high):
        y = down(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{width - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
                     f'<text class="tick" x="{LEFT - 4}" y="{y + 3:.1f}" text-anchor="end">'
                     f'{_number(10**tick if log_y else tick)}</text>')
    step = inner_width / len(names)
    bar = 0.8 * step / len(series)
    for n, name in enumerate(names):
        for s, label in enumerate(series):
            value = values[s, n]
            if not np.isfinite(value) or (log_y and value <= 0):
                continue
            top = down(math.log10(value) if log_y else value)
            base = down(low if log_y else 0.0)
            parts.append(f'<rect x="{LEFT + n * step + 0.1 * step + s * bar:.1f}" y="{min(top, base):.1f}" '
                         f'width="{bar:.1f}" height="{max(abs(base - top), 0.5):.1f}" fill="{colours[label]}">'
                         f"<title>{escape(name)}, {escape(label)}: {value:.4g}</title></rect>")
        x, y = LEFT + (n + 0.5) * step, TOP + inner_height + 12
        parts.append(f'<text class="tick" transform="translate({x:.1f} {y:.1f}) rotate(-38)" text-anchor="end">'
                     f"{escape(name)}</text>")
    parts += _legend([(label, colours[label], "") for label in series], width)
    return _svg(width, height, parts)


def interval_bar(
    value: float, interval: tuple[float, float], bounds: tuple[float, float], initial: float, log: bool = False
) -> str:
    """Small SVG: the range of a parameter, its interval, fitted value (dot) and initial value (tick)."""
    width, height = 150, 16

    def across(x: float) -> float:
        low, high = bounds
        if log and low > 0:
            share = math.log(max(x, low) / low) / math.log(high / low)
        else:
            share = (x - low) / (high - low) if high > low else 0.5
        return 4 + min(max(share, 0.0), 1.0) * (width - 8)

    left, right = (across(x) for x in interval)
    return (f'<svg class="mini" width="{width}" height="{height}" role="img"><title>{bounds[0]:.4g} to {bounds[1]:.4g}'
            f'</title><line x1="4" x2="{width - 4}" y1="8" y2="8" stroke="#c8c8c8"/>'
            f'<rect x="{left:.1f}" y="5" width="{max(right - left, 1):.1f}" height="6" fill="#9cc3e6"/>'
            f'<line x1="{across(initial):.1f}" x2="{across(initial):.1f}" y1="2" y2="14" stroke="#e08214" '
            f'stroke-width="1.6"/><circle cx="{across(value):.1f}" cy="8" r="3" fill="#1f6fb4"/></svg>')


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    return (f'<svg class="chart" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" height="{height:.0f}" '
            f'role="img">{"".join(parts)}</svg>')


def _frame(width: float, height: float, title: str, x_label: str, y_label: str) -> str:
    middle = TOP + (height - TOP - BOTTOM) / 2
    return (f'<text class="title" x="{LEFT}" y="13">{escape(title)}</text>'
            f'<text class="label" x="{(LEFT + width - RIGHT) / 2:.0f}" y="{height - 4}" text-anchor="middle">'
            f'{escape(x_label)}</text><text class="label" transform="translate(11 {middle:.0f}) rotate(-90)" '
            f'text-anchor="middle">{escape(y_label)}</text>')


def _ticks(
    x_range: tuple[float, float], y_range: tuple[float, float], across: Scale, down: Scale, width: float,
    height: float,
) -> list[str]:
    parts = []
    x_ticks, y_ticks = _nice_ticks(*x_range), _nice_ticks(*y_range)
    for tick, label in zip(x_ticks, _labels(x_ticks), strict=True):
        x = float(across(tick))
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{height - BOTTOM}"/>'
                     f'<text class="tick" x="{x:.1f}" y="{height - BOTTOM + 12}" text-anchor="middle">'
                     f"{label}</text>")
    for tick, label in zip(y_ticks, _labels(y_ticks), strict=True):
        y = float(down(tick))
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{width - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
                     f'<text class="tick" x="{LEFT - 4}" y="{y + 3:.1f}" text-anchor="end">{label}</text>')
    return parts


def _polyline(x: np.ndarray, y: np.ndarray, line: Line) -> str:
    every = max(len(x) // MAX_POINTS, 1)
    x, y = x[::every], y[::every]
    commands, broken = [], True
    for one, other in zip(x, y, strict=True):
        if not (np.isfinite(one) and np.isfinite(other)):
            broken = True
            continue
        commands.append(f"{'M' if broken else 'L'}{one:.1f} {other:.1f}")
        broken = False
    dash = f' stroke-dasharray="{line.dash}"' if line.dash else ""
    path = (f'<path d="{"".join(commands)}" fill="none" stroke="{line.colour}" stroke-width="{line.width}"{dash} '
            'stroke-linejoin="round"/>')
    if line.markers:
        path += "".join(f'<circle cx="{one:.1f}" cy="{other:.1f}" r="2.2" fill="{line.colour}"/>'
                        for one, other in zip(x, y, strict=True) if np.isfinite(one) and np.isfinite(other))
    return path


def _legend(entries: Sequence[tuple[str, str, str]], width: float) -> list[str]:
    """Legend in the title line, from the right."""
    parts, x = [], width - RIGHT
    for label, colour, dash in reversed(list(dict.fromkeys(entries))):
        x -= 5.6 * len(label) + 24
        style = f' stroke-dasharray="{dash}"' if dash else ""
        parts.append(f'<line x1="{x:.1f}" x2="{x + 14:.1f}" y1="9" y2="9" stroke="{colour}" stroke-width="2.4"{style}/>'
                     f'<text class="tick" x="{x + 17:.1f}" y="12">{escape(label)}</text>')
    return parts


def _range(values: np.ndarray, smallest: float = 0.0) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    size = max(abs(low), abs(high))
    span = max(high - low, smallest)
    if span <= 1e-6 * size or span == 0:  # a constant, but for rounding
        span = 0.1 * size or 1.0
    middle = (low + high) / 2
    return middle - 0.53 * span, middle + 0.53 * span


def _centred(limits: tuple[float, float], span: float) -> tuple[float, float]:
    middle = sum(limits) / 2
    return middle - span / 2, middle + span / 2


def _nice_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers between low and high, about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """Exponents of 1, 2, 5 per decade between low and high; decades only where there are many."""
    factors = (1, 2, 5) if high - low < 2.5 else (1,)
    decades = range(math.floor(low), math.ceil(high) + 1)
    return [t for k in decades for f in factors if low <= (t := k + math.log10(f)) <= high]


def _labels(ticks: Sequence[float]) -> list[str]:
    """Labels of ticks with as many digits as it takes to distinguish them."""
    return next((found for digits in range(4, 10) if len(set(found := [_number(tick, digits) for tick in ticks]))
                 == len(ticks)), [_number(tick) for tick in ticks])  # fmt: skip


def _number(value: float, digits: int = 4) -> str:
    if 1e4 <= abs(value) < 1e7:
        return f"{value:,.0f}"
    return "0" if abs(value) < 1e-12 else f"{value:.{digits}g}"
