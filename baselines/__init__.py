"""Host-side baselines in numpy and Embree; they share no code with the OpenCL side."""

from .brute_force import BruteForceTracer
from .embree import EmbreeTracer
from .packet import PacketTracer, render_packets
from .reference import render_reference

__all__ = [
    "BruteForceTracer",
    "EmbreeTracer",
    "PacketTracer",
    "render_packets",
    "render_reference",
]
