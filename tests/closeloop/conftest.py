"""Worlds that the loop is closed over."""

from tests.worlds import open_ground, predicted_by_the_model_alone

__all__ = ["open_ground", "predicted_by_the_model_alone"]
