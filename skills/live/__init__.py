"""The live arm: a bus, what is said on it, a stand-in for a dVRK, and a check that only listens.

    Bus, arm --listened--> Heard --check--> ArmReport        what an arm says, and what is wrong with it
    Bus, StandIn --run--> an arm that is simulated, on the bus

A laboratory may read this room before it lets it move an arm. Nothing in it was run on a robot.
"""
