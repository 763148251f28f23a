"""nlt: learned light transport, after "Learning Neural Light Transport" (Sanzenbacher, Mescheder, Geiger)."""

__version__ = "0.1.0"
