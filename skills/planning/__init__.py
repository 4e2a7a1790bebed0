"""Planning: from a policy to the motion of both arms at successive suture points. Pure: numpy in, numpy out."""
