"""Smooth or banded systems in place of discontinuous ones."""

from ._kinks import mark_kinks as mark_kinks
from ._regularise import banded as banded, smoothed as smoothed
