"""LeRobot datasets of a dVRK, v2.1 and v3.0: reading one episode, and cutting a dataset into zips of one episode.

    folder or zip --find_dataset--> Dataset --cut_episode--> zip of one episode --read_episode--> Recording

One episode is one recording: a reader refuses several, so that the stored bytes of a recording belong to one surgeon.
"""
