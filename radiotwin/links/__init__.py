"""Measured links: joined with devices, 3D map and geometry once, checked, and cut into parts."""

from radiotwin.links.correlation import correlation_length_m
from radiotwin.links.evidence import design_effect, evidence_blocks, places, with_evidence
from radiotwin.links.links import LinkGeometry, Links, link_geometry
from radiotwin.links.prepare import join_links, prepare_links
from radiotwin.links.sites import site_of
from radiotwin.links.variables import residual_variable, residual_variables

__all__ = ["Links", "LinkGeometry", "correlation_length_m", "design_effect", "evidence_blocks",
           "join_links", "link_geometry", "places", "prepare_links", "residual_variable",
           "residual_variables", "site_of", "with_evidence"]
