#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Processor time of the camera driver, with a listener in its process, beside a bare Aravis loop: both on the same
camera, one after the other, in rounds. All of both processes counts, user and system.

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
    camera = foreign_camera.Camera()

    def milliseconds(program):
        """Of processor time a frame."""
        printed = subprocess.check_output(
            [program, '127.0.0.1', str(options.width), str(options.height), str(options.rate), str(PACKET_BYTES),
             str(options.seconds)], text=True)
        frames, seconds = printed.splitlines()[-1].split()
        if int(frames) < 0.8 * options.rate * options.seconds:
            print('      %s: only %s frames in %d s' % (program, frames, options.seconds), flush=True)
        return 1e3 * float(seconds) / int(frames)

    ratios = []
    with foreign_camera.Master():
        camera.start()
        time.sleep(1.0)
        try:
            for _ in range(options.rounds):
                bare, driver = milliseconds('bare_aravis_loop'), milliseconds('camera_driver_loop')
                ratios.append(driver / bare)
                print('      %dx%d at %g Hz, ms a frame: bare loop %.3f, driver %.3f, ratio %.2f' % (
                    options.width, options.height, options.rate, bare, driver, ratios[-1]), flush=True)
        finally:
            camera.kill()
    middle = statistics.median(ratios)
    print('%s  processor time of the driver: %.2f times the bare loop (median of %d)' % (
        'ok  ' if middle <= options.most else 'FAIL', middle, len(ratios)))
    return 0 if middle <= options.most else 1


if __name__ == '__main__':
    sys.exit(main())
