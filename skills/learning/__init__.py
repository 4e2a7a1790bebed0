"""Learning: from a reward map to Q values, a policy, its certificate and its evaluation. Pure: numpy in, numpy out."""
