"""Processes under limits, so that whatever they do they do to themselves.

Two ways to start one:
    fresh       a new interpreter: nothing of ours is in it, and it takes a while to import what it needs
    forked      a fork of a small server that has imported everything already: ready in a millisecond or two

Either way the process sees next to nothing of our environment, may use so much memory, time, files and output, is
killed when the time is over or its parent dies, and says by its exit code what became of it. Nothing is unpickled.
"""
