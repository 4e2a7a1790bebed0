"""The grid world (Sec. III-B, III-C): cells, moves, rewards, phases. Pure: numpy in, numpy out."""
