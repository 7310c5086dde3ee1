#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Processor time of the camera driver, with a listener in its process, beside a bare Aravis loop: both at the same time,
so that whatever else the machine does meets both, each on a camera of its own, which they swap from round to round. User and
system time of all threads counts; what the same ROS process takes without a driver is told, and taken off. Needs a network of its own (root, or user namespaces) for the second camera.

    ./run bench camera [--rounds 5] [--seconds 15] [--width 1280] [--height 960] [--rate 30]

Exit status 0 when the median of the rounds' ratios is at most --most.
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
    parser.add_argument('--rounds', type=int, default=5)
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
        """Of processor time a frame: all, and without what a ROS process at rest takes."""
        frames, seconds, *rest = process.communicate()[0].splitlines()[-1].split()
        if int(frames) < 0.8 * options.rate * options.seconds:
            print('      %s: only %s frames in %d s' % (process.args[0], frames, options.seconds), flush=True)
        everything = 1e3 * float(seconds) / int(frames)
        return everything, everything - 1e3 * float((rest or ['0'])[0]) / int(frames)

    ratios = []
    with foreign_camera.Master():
        for camera in cameras:
            camera.start()
        time.sleep(1.0)
        try:
            for _ in range(options.rounds):
                both = start('bare_aravis_loop', cameras[0]), start('camera_driver_loop', cameras[1])
                (bare, _), (everything, driver) = [milliseconds(process) for process in both]
                cameras.reverse()
                ratios.append(driver / bare)
                print('      %dx%d at %g Hz, ms a frame: bare loop %.3f, driver %.3f (and ROS at rest: %.3f), ratio %.2f '
                      '(%.2f)' % (options.width, options.height, options.rate, bare, driver, everything, ratios[-1],
                                  everything / bare), flush=True)
        finally:
            for camera in cameras:
                camera.kill()
    middle = statistics.median(ratios)
    print('%s  processor time of the driver: %.2f times the bare loop (median of %d)' % (
        'ok  ' if middle <= options.most else 'FAIL', middle, len(ratios)))
    return 0 if middle <= options.most else 1


if __name__ == '__main__':
    sys.exit(main())
