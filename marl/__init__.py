"""Multi-UAV data harvesting: a mission in a radio map, and learners that plan its flights.

After Chen et al., "Model-aided Federated Reinforcement Learning for Multi-UAV Trajectory Planning
in IoT Networks", GLOBECOM Workshops 2023; called "the paper" throughout the package.

Read first `mission` (the inputs) and `environment` (the rules, and what agents see);
then a learner: `qmix` (with IQL), `fedqmix.federation`, `planner` or `heuristics`; then
`algorithm1`.
"""
