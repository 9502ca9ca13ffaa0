"""Body models: the licence-free body's generator, model files, skinning."""

from .model import BodyModel, BodyModelError, load_body

__all__ = ["BodyModel", "BodyModelError", "load_body"]
