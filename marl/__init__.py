"""Multi-UAV data harvesting: a mission in a radio map, and what plans it (QMIX, IQL, federated QMIX, a planner).

After Chen et al., "Model-aided Federated Reinforcement Learning for Multi-UAV Trajectory Planning in IoT Networks",
GLOBECOM Workshops 2023; called "the paper" throughout the package.
"""
