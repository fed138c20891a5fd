"""The model of a level: channel, effects, and their fit."""
