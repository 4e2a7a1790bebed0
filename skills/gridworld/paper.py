"""Every number that the paper states, one line each, and nothing else.

"Collaborative Suturing: A Reinforcement Learning Approach to Automate Hand-off Task in Suturing for Surgical Robots".
A number that we chose is the default of a settings class, with its reason there.
"""

GRID_SHAPE = (11, 11, 11)  # Sec. III-B and III-C: gridsize 11, 1331 points
CELL_MM = 5.0  # Sec. III-C: a unit grid world is 5 x 5 x 5 mm
N_ACTIONS = 27  # Sec. III-C: [-ve, 0, +ve]^3
MAX_STEPS = 100  # Sec. III-C: steps after which an episode ends
MAX_EPISODE_S = 30 * 60.0  # Sec. III-C: time allotted to the PSM for an episode
USER_START_MM = (-10.0, 55.0, -135.0)  # Sec. IV: the user's initial position
N_POLICIES = 3  # Sec. IV: policies learnt from one demonstration
FIG9_START_RANGE_MM = ((-25.0, -5.0), (50.0, 60.0), (-130.0, -135.0))  # Sec. IV: the range of other starts
TABLE1_MEAN_MM = (2.857, 1.488, 0.774)  # Table I
TABLE1_STD_MM = (3.388, 2.286, 1.808)  # Table I
RMSE_AS_PRINTED_MM = (0.0044, 0.0027, 0.0020)  # Abstract and Sec. IV: in fact metres, as sqrt(mean^2 + std^2) shows
SIMILARITY_MEAN_MM = 1.706  # Sec. V-A
SIMILARITY_STD_MM = 2.494  # Sec. V-A

# Not printed in the paper, but determined by its published data: the grid's origin in the PSM's base frame.
GRID_ORIGIN_MM = (-30.0, 25.0, -140.0)
