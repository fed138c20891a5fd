"""Fly UAVs through a truth map and bring back measurements."""

from radiotwin.maps.survey.campaign import PATTERNS, fly_survey
from radiotwin.maps.survey.truth import read_truth, segmented_truth

__all__ = ["PATTERNS", "fly_survey", "read_truth", "segmented_truth"]
