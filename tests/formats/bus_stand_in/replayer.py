"""What `dvrk_bag_replay.py -m servo_jp -j` does with a bag, for tests without the laboratory's script."""

import argparse
import time

import crtk
import rosbag2_py
from rclpy.serialization import deserialize_message

options = argparse.ArgumentParser()
for name in ("-a", "-b", "-m"):
    options.add_argument(name, required=True)
options.add_argument("-j", action="store_true", required=True)
asked = options.parse_args()
assert asked.m == "servo_jp"
reader = rosbag2_py.SequentialReader()
reader.open(rosbag2_py.StorageOptions(uri=asked.b, storage_id="mcap"), None)
found = {f"/{asked.a}/setpoint_js": [], f"/{asked.a}/jaw/setpoint_js": []}
while reader.has_next():
    topic, data, _ = reader.read_next()
    if topic in found:
        said = deserialize_message(data, reader.types[topic])
        kept = found[topic]
        if crtk.ral.to_sec(said.header.stamp) > (crtk.ral.to_sec(kept[-1].header.stamp) if kept else 0.0):
            kept.append(said)
arm, jaw = argparse.Namespace(), argparse.Namespace()
for device, name in ((arm, f"/{asked.a}"), (jaw, f"/{asked.a}/jaw")):
    made = crtk.utils(device, crtk.ral(name))
    made.add_servo_jp()
    made.add_move_jp()
setpoints, jaws = found.values()
input('-> Press "Enter" to move to start position')
arm.move_jp(setpoints[0].position).wait()
jaw.move_jp(jaws[0].position).wait()
input('-> Press "Enter" to replay trajectory')
last_s = crtk.ral.to_sec(setpoints[0].header.stamp)
for one, angle in zip(setpoints, jaws, strict=False):
    began_s = time.time()
    arm.servo_jp(one.position, one.velocity)
    jaw.servo_jp(angle.position, angle.velocity)
    new_s = crtk.ral.to_sec(one.header.stamp)
    time.sleep(max(0.0, new_s - last_s - (time.time() - began_s)))
    last_s = new_s
