"""Regression model of a link's level: channel, effects, and their fit."""
