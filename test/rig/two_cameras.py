#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""The simulated pair of cameras, 127.0.0.1 and 127.0.0.2, as demo_two_cameras.launch starts it: clouds come, of the
room as it is, and no pair is further apart in time than the launch file allows.

    ./run exec test/rig/two_cameras.py [--clouds N]

Exit status 0 when all that holds; 77 where a network of its own cannot be had."""
import argparse
import math
import statistics
import struct
import sys
import tempfile
from pathlib import Path

import lab

FRAME_RATE = 2.0                # of demo_two_cameras.launch [Hz]
MOST_APART = 0.5 / FRAME_RATE   # of two cameras that run freely [s]
ROOM = 0.5, 12.0                # ranges of the room [m]


class Pair:
    def __init__(self, rospy):
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import CameraInfo, PointCloud2
        self.told = {}
        rospy.Subscriber('/diagnostics', DiagnosticArray, self.on_diagnostics, queue_size=50)
        self.stamps = {'left': [], 'right': []}
        self.clouds = []
        for side in self.stamps:
            rospy.Subscriber('/camera/%s/camera_info' % side, CameraInfo, self.on_image, side, queue_size=50)
        rospy.Subscriber('/camera/points2', PointCloud2, self.on_cloud, queue_size=5, buff_size=1 << 26)

    def on_diagnostics(self, array):
        for status in array.status:
            if status.name.endswith(': stereo'):
                self.told = {value.key: value.value for value in status.values}

    def on_image(self, message, side):
        self.stamps[side].append(message.header.stamp.to_sec())

    def on_cloud(self, cloud):
        """Keeps the ranges of some of its points."""
        at = {field.name: field.offset for field in cloud.fields}
        ranges = []
        for row in range(0, cloud.height, 16):
            for column in range(0, cloud.width, 16):
                base = row * cloud.row_step + column * cloud.point_step
                xyz = [struct.unpack_from('<f', cloud.data, base + at[axis])[0] for axis in 'xyz']
                ranges.append(math.sqrt(sum(value * value for value in xyz)))
        self.clouds.append((cloud.header.stamp.to_sec(), ranges))


def check(problems, holds, text):
    print('%s  %s' % ('ok  ' if holds else 'FAIL', text), flush=True)
    if not holds:
        problems.append(text)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--clouds', type=int, default=5)
    options = parser.parse_args()
    lab.own_network()
    problems = []
    with tempfile.TemporaryDirectory(prefix='omnister_pair_') as folder:
        work = Path(folder)
        (work / 'log').mkdir()
        processes, clock = lab.demo.Processes(work / 'log'), lab.demo.Clock(None)
        try:
            lab.demo.prepare_environment(work, False)
            lab.start_master(processes, clock)
            import rospy
            output = []
            processes.start('roslaunch', ['roslaunch', '--skip-log-check', 'omnister', 'demo_two_cameras.launch', 'gui:=false',
                                          'port:=%s' % (work / 'stage')], output.append)
            rospy.init_node('pair', disable_signals=True)
            pair = Pair(rospy)
            clock.wait('%d clouds' % options.clouds, lambda: len(pair.clouds) >= options.clouds, 240.0)
            clock.wait('the diagnostics', lambda: int(pair.told.get('clouds', 0)) >= options.clouds, 30.0)
            apart = float(pair.told['between left and right, most [s]'])
            check(problems, 0.0 <= apart <= MOST_APART,
                  'left and right at most %.3f s apart, %.3f s are allowed' % (apart, MOST_APART))
            # The first of them may have come before these listeners were heard of.
            clouds = [stamp for stamp, _ in pair.clouds if stamp >= pair.stamps['left'][0]]
            nearest = [min(abs(stamp - right) for right in pair.stamps['right']) for stamp in clouds]
            check(problems, set(clouds) <= set(pair.stamps['left']) and max(nearest) <= MOST_APART,
                  '%d clouds, each of a left image, a right one at most %.3f s from it' % (len(clouds), max(nearest)))
            shares, middles = [], []
            for _, ranges in pair.clouds:
                valid = [value for value in ranges if math.isfinite(value)]
                shares.append(len(valid) / len(ranges))
                middles.append(statistics.median(valid) if valid else math.nan)
            check(problems, min(shares) > 0.3, 'at least %.0f %% of the pixels have a range' % (100.0 * min(shares)))
            check(problems, all(ROOM[0] < middle < ROOM[1] for middle in middles),
                  'middle range %.2f to %.2f m' % (min(middles), max(middles)))
            died = [line for line in output if 'has died' in line]
            check(problems, not died, 'no process ended' + ''.join(died[:3]))
            rospy.signal_shutdown('done')
        except lab.demo.Failure as failure:
            check(problems, False, str(failure))
            print('\n'.join(output[-20:]), file=sys.stderr)
        finally:
            processes.stop_all()
    return 1 if problems else 0


if __name__ == '__main__':
    sys.exit(main())
