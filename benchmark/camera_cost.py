#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Processor time of the camera driver beside a bare Aravis loop: both at the same time, so that whatever else the
machine does meets both, each on a camera of its own, which they swap from round to round. User and system time of all
threads counts. The driver has a listener in its process. What that ROS process takes without a driver, and what the
listener's own thread takes, is told and taken off: the loop has neither. Waking that thread is the driver's part. Needs a
network of its own (root, or user namespaces) for the second camera.

    ./run bench camera [--rounds 8] [--seconds 15] [--width 1280] [--height 960] [--rate 30]

Exit status 0 when the ratio of the medians is at most --most.
"""
import argparse
import os
import statistics
import subprocess
import sys
import time

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), '..', 'test'))
import foreign_camera  # noqa: E402

PACKET_BYTES = 16000


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rounds', type=int, default=8)
    parser.add_argument('--seconds', type=int, default=15, help='of each measurement')
    parser.add_argument('--width', type=int, default=1280)
    parser.add_argument('--height', type=int, default=960)
    parser.add_argument('--rate', type=float, default=30.0, help='[Hz]')
    parser.add_argument('--most', type=float, default=1.3, help='ratio that is still well')
    options = parser.parse_args()
    foreign_camera.skip_without_camera()
    foreign_camera.enter_own_network()
    if 'FOREIGN_CAMERA' not in os.environ:
        print('skipped: no network of its own can be made for two cameras', file=sys.stderr)
        return 77
    cameras = [foreign_camera.Camera('127.0.0.1', 'FIRST'), foreign_camera.Camera('127.0.0.2', 'SECOND')]

    def start(program, camera):
        return subprocess.Popen(
            [program, camera.address, str(options.width), str(options.height), str(options.rate), str(PACKET_BYTES),
             str(options.seconds)], stdout=subprocess.PIPE, text=True)

    def milliseconds(process):
        """Of processor time a frame, as the program tells it."""
        frames, *seconds = process.communicate()[0].splitlines()[-1].split()
        if int(frames) < 0.8 * options.rate * options.seconds:
            print('      %s: only %s frames in %d s' % (process.args[0], frames, options.seconds), flush=True)
        return [1e3 * float(s) / int(frames) for s in seconds]

    rounds = []
    with foreign_camera.Master():
        for camera in cameras:
            camera.start()
        time.sleep(1.0)
        try:
            for _ in range(options.rounds):
                with_driver = start('camera_driver_loop', cameras[1])
                with_driver.stdout.readline()
                both = start('bare_aravis_loop', cameras[0]), with_driver
                (bare,), (everything, rest, listener) = [milliseconds(process) for process in both]
                cameras.reverse()
                driver = everything - rest - listener
                rounds.append((bare, driver, everything))
                print('      %dx%d at %g Hz, ms a frame: bare loop %.3f, driver %.3f (and listener %.3f, ROS at rest %.3f), '
                      'ratio %.2f (all %.2f)' % (options.width, options.height, options.rate, bare, driver, listener, rest,
                                                 driver / bare, everything / bare), flush=True)
        finally:
            for camera in cameras:
                camera.kill()
    bare, driver, everything = (statistics.median(column) for column in zip(*rounds))
    print('%s  processor time of the driver: %.2f times the bare loop, with listener and ROS at rest %.2f (medians of %d)' % (
        'ok  ' if driver / bare <= options.most else 'FAIL', driver / bare, everything / bare, len(rounds)))
    return 0 if driver / bare <= options.most else 1


if __name__ == '__main__':
    sys.exit(main())
