"""Reads a sampled signal at instants between its samples."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from firmware_iface.recording import FloatArray, RecordedSignal


class SamplingLimits(msgspec.Struct, frozen=True):
    """Limits between the rules by which measured signals come to ticks."""

    nearest: float = 0.75
    """Samples a tick below which each goes to the nearest tick."""
    averaged: float = 16.0
    """Samples a tick from which on the mean of several is taken."""
    averaging: float = 1.0 / 16.0
    """Ticks on either side of an instant whose samples are averaged."""
    gap: float = 2.5
    """Sampling intervals between neighbours beyond which nothing is interpolated."""
    quiet: float = 0.2
    """Share of the second differences that are noise: tests rest and creep for longer."""
    quiet_second: float = 0.253 * math.sqrt(6.0)
    """That quantile of the size of second differences of white noise, in its deviations."""
    error: float = 1.0
    """Largest error of a cubic, in deviations of the noise: as much as that again."""


SAMPLING = SamplingLimits()


def sampling_interval(signal: RecordedSignal) -> float:
    """Usual time between two samples, s."""
    return float(np.median(np.diff(signal.time))) if len(signal.time) > 1 else np.inf


def values_at(
    signal: RecordedSignal, instants: FloatArray, period: float
) -> tuple[FloatArray, str]:
    """Values of a signal at instants, and the rule by which they came.

    signal: as recorded; instants: s, ascending, a tick apart, shape (n,); period: length of a tick,
    s. Returns NaN where there is none, shape (n,); the rule in words, with its error.
    """
    step = sampling_interval(signal)
    rate = period / step
    if rate < SAMPLING.nearest:
        return _nearest(signal, instants, period), (
            "each sample at the nearest tick, off by up to half a tick"
        )
    if rate >= SAMPLING.averaged:
        return _mean(signal, instants, SAMPLING.averaging * period), (
            f"mean of the samples within {SAMPLING.averaging * period * 1e3:.3g} ms of each"
            " tick's end"
        )
    return _cubic(signal, instants, SAMPLING.gap * step), "a cubic through four samples"


def _cubic(signal: RecordedSignal, instants: FloatArray, most: float) -> FloatArray:
    """Values of cubics through two samples on either side (Lagrange).

    NaN next to gaps, and where fourth differences say that the cubic is off by more than noise: an
    edge between two samples is not to be read.
    """
    time, value = signal.time, signal.value
    right = np.clip(np.searchsorted(time, instants), 3, len(time) - 3)
    place = [time[right + k] for k in (-2, -1, 0, 1)]
    out = np.zeros(len(instants))
    for own in range(4):
        weight = np.ones(len(instants))
        for other in range(4):
            if other != own:
                weight *= (instants - place[other]) / (place[own] - place[other])
        out += weight * value[right - 2 + own]
    part = np.clip((instants - place[1]) / (place[2] - place[1]), 0.0, 1.0)
    fourth = np.abs(np.diff(value, 4))
    turn = np.maximum(fourth[right - 3], fourth[right - 2])
    error = part * (1.0 - part) * (1.0 + part) * (2.0 - part) / 24.0 * turn
    second = np.abs(np.diff(value, 2))
    noise = float(np.quantile(second, SAMPLING.quiet)) / SAMPLING.quiet_second
    noise = max(noise, float(np.diff(np.unique(value)).min(initial=np.inf)) / math.sqrt(12.0))
    inside = (instants >= time[0]) & (instants <= time[-1]) & (place[3] - place[0] <= 2.0 * most)
    return np.where(inside & (error <= SAMPLING.error * noise), out, np.nan)


def _mean(signal: RecordedSignal, instants: FloatArray, width: float) -> FloatArray:
    low = np.searchsorted(signal.time, instants - width)
    high = np.searchsorted(signal.time, instants + width, side="right")
    total = np.concatenate([[0.0], np.cumsum(signal.value - signal.value[0])])
    count = high - low
    mean = (total[high] - total[low]) / np.maximum(count, 1) + signal.value[0]
    return np.where(count > 0, mean, np.nan)


def _nearest(signal: RecordedSignal, instants: FloatArray, period: float) -> FloatArray:
    out = np.full(len(instants), np.nan)
    index = np.rint(np.interp(signal.time, instants, np.arange(len(instants)))).astype(np.int64)
    near = np.abs(instants[index] - signal.time) <= 0.5 * period
    out[index[near]] = signal.value[near]
    return out
