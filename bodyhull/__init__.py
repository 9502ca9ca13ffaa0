"""bodyhull: from a calibrated multi-camera recording of a clothed person to the body under the clothes."""

__version__ = "0.1.0"
