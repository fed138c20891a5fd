"""Multi-UAV data harvesting, planned inside a radio map (see docs/ for what is built so far)."""
