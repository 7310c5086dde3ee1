#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The camera node against a camera that nobody here wrote (Debian's arv-fake-gv-camera-0.8), for long:
every frame accounted for, lost packets, kill -9, a frozen camera, many reconnections. (What it costs: ./run bench camera.)

    ./run exec test/ros/camera_endurance.py [--minutes 10] [--cycles 50]

Runs in a network of its own where that is allowed. Exit status 0 when all bounds hold.
"""
import argparse
import ctypes
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time

import numpy

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), '..'))
import foreign_camera  # noqa: E402

failures = []


def check(holds, text):
    print('%s  %s' % ('ok  ' if holds else 'FAIL', text), flush=True)
    if not holds:
        failures.append(text)


class Wire:
    """What the camera really sends: numbers of the frames whose first or last packet is on the loopback."""
    # Ethernet, IPv4, UDP, not GigE Vision's control port, a leader (1) or trailer (2) of its stream.
    FILTER = [(0x28, 0, 0, 12), (0x15, 0, 10, 0x800), (0x30, 0, 0, 23), (0x15, 0, 8, 17), (0x28, 0, 0, 34),
              (0x15, 6, 0, 3956), (0x28, 0, 0, 36), (0x15, 4, 0, 3956), (0x30, 0, 0, 46), (0x15, 1, 0, 1),
              (0x15, 0, 1, 2), (0x06, 0, 0, 256), (0x06, 0, 0, 0)]

    def __init__(self):
        program = b''.join(struct.pack('HBBI', *line) for line in self.FILTER)
        memory = ctypes.create_string_buffer(program)
        self.socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x0800))
        so_attach_filter = 26
        self.socket.setsockopt(socket.SOL_SOCKET, so_attach_filter,
                               struct.pack('HL', len(self.FILTER), ctypes.addressof(memory)))
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self.socket.bind(('lo', 0))
        self.numbers = []
        threading.Thread(target=self.listen, daemon=True).start()

    def listen(self):
        while True:
            data, address = self.socket.recvfrom(256)
            outgoing = 4
            if address[2] == outgoing or len(data) < 50:
                continue
            number = struct.unpack('>H', data[44:46])[0]
            if not self.numbers or self.numbers[-1] != number:
                self.numbers.append(number)

    def between(self, first, last):
        """Frames sent after the one with the number `first` up to `last`, of the last that have these numbers."""
        numbers = list(self.numbers)
        end = len(numbers) - 1 - numbers[::-1].index(last)
        # Numbers come again after 65535 frames, which is 43 minutes.
        begin = max(i for i, number in enumerate(numbers[:end + 1]) if number == first)
        return end - begin


class Node:
    """camera_node, and what it says."""

    def __init__(self, rospy, **parameters):
        from diagnostic_msgs.msg import DiagnosticArray
        from rosgraph_msgs.msg import Log
        from sensor_msgs.msg import CameraInfo, Image
        self.frames = 0
        self.last_frame = 0.0
        self.stamps = []
        self.warned = None
        self.diagnostics = {}
        self.images, self.broken = 0, 0
        self.subscribe_images = lambda: self.subscribers.append(
            rospy.Subscriber('image_raw', Image, self.on_image, queue_size=1, buff_size=1 << 24))
        defaults = dict(device='aravis:ENDURE', width=2048, height=2048, offset_x=0, offset_y=0, frame_rate=25.0,
                        diagnostic_period=0.5, store=tempfile.gettempdir())
        defaults.update(parameters)
        self.process = subprocess.Popen(['camera_node', '__name:=endure'] +
                                        ['_%s:=%s' % item for item in defaults.items()])
        self.subscribers = [rospy.Subscriber('camera_info', CameraInfo, self.on_info, queue_size=1000),
                            rospy.Subscriber('/diagnostics', DiagnosticArray, self.on_diagnostics),
                            rospy.Subscriber('/rosout', Log, self.on_log)]

    def on_info(self, message):
        self.frames += 1
        self.last_frame = time.monotonic()
        self.stamps.append(message.header.stamp.to_sec())

    def on_image(self, message):
        image = numpy.frombuffer(message.data, numpy.uint8).reshape(message.height, message.step)
        # The camera's pattern slides along the diagonal, and with every frame.
        self.images += 1
        if not (image[1:, :-1] == image[:-1, 1:]).all():
            self.broken += 1

    def on_diagnostics(self, message):
        for status in message.status:
            if 'endure' in status.name:
                self.diagnostics = {value.key: value.value for value in status.values}

    def on_log(self, message):
        if message.level >= 4 and 'no frame for' in message.msg:
            self.warned = time.monotonic()

    def value(self, key):
        return int(self.diagnostics.get(key, '0'))

    def settled_diagnostics(self):
        """The next ones, when what they tell of has surely been seen on the wire."""
        old = self.diagnostics
        while self.diagnostics is old:
            time.sleep(0.01)
        new = self.diagnostics
        time.sleep(1.0)
        return new

    def resources(self):
        """Resident memory [MB], threads, open files."""
        status = open('/proc/%d/status' % self.process.pid).read()
        return (int(re.search(r'VmRSS:\s+(\d+)', status).group(1)) / 1024,
                int(re.search(r'Threads:\s+(\d+)', status).group(1)),
                len(os.listdir('/proc/%d/fd' % self.process.pid)))

    def wait_frames(self, count, timeout=60.0):
        end = time.monotonic() + timeout
        want = self.frames + count
        while self.frames < want:
            if time.monotonic() > end or self.process.poll() is not None:
                raise RuntimeError('no frames, exit status %s: %s' % (self.process.poll(), self.diagnostics))
            time.sleep(0.01)

    def close(self):
        for subscriber in self.subscribers:
            subscriber.unregister()
        self.process.send_signal(signal.SIGINT)
        began = time.monotonic()
        self.process.wait(30)
        return time.monotonic() - began


def account(node, wire, seconds):
    """What the node counts in that time, beside what was on the wire."""
    node.wait_frames(30)
    before = node.settled_diagnostics()
    time.sleep(seconds)
    after = node.settled_diagnostics()
    counts = [int(after[key]) - int(before[key]) for key in ('frames published', 'frames lost', 'frames incomplete')]
    key = 'number of the last frame'
    sent = wire.between(int(before[key]), int(after[key]))
    print('      %.0f s: %d sent, %d published, %d lost (%d incomplete, %s without memory, %s packets missing)' % (
        seconds, sent, counts[0], counts[1], counts[2], after['frames without memory'], after['packets missing']), flush=True)
    check(sent == counts[0] + counts[1], 'every frame sent is published or counted as lost')
    return counts


def recovery(node, camera, name, go, come_back):
    node.warned = None
    go()
    gone = time.monotonic()
    end = gone + 30.0
    while node.warned is None and time.monotonic() < end:
        time.sleep(0.005)
    warned = (node.warned or end) - gone
    if name == 'frozen 10 s':
        time.sleep(max(0.0, 10.0 - (time.monotonic() - gone)))
    time.sleep(1.5)
    had = node.frames
    if node.value('frames published') != had:
        check(False, '%s: %d frames were published, %d came' % (name, node.value('frames published'), had))
    come_back()
    back = time.monotonic()
    while node.frames <= had and time.monotonic() < back + 60.0:
        time.sleep(0.005)
    return warned, time.monotonic() - back


def endure(options):
    camera, node, wire = foreign_camera.Camera(), None, Wire()
    try:
        import rospy
        rospy.init_node('camera_endurance', disable_signals=True)
        camera.start()
        node = Node(rospy)

        published, lost, incomplete = account(node, wire, 60.0 * options.minutes)
        print('      %.2f %% of the frames lost' % (100.0 * lost / (published + lost)))
        steps = [b - a for a, b in zip(node.stamps, node.stamps[1:])]
        check(all(step > 0 for step in steps), 'stamps increase')

        for name, go, come_back in (
                ('killed', camera.kill, camera.start),
                ('frozen 10 s', lambda: camera.signal(signal.SIGSTOP), lambda: camera.signal(signal.SIGCONT))):
            warned, streaming = recovery(node, camera, name, go, come_back)
            check(warned <= 2.0, '%s: warned of after %.2f s' % (name, warned))
            check(streaming <= 5.0, '%s: streams %.2f s after its return' % (name, streaming))

        node.close()
        camera.kill()
        camera.start(lost_per_thousand=1)
        # Some 260 packets a frame: one of four comes torn.
        node = Node(rospy)
        node.wait_frames(5)
        node.subscribe_images()
        published, lost, incomplete = account(node, wire, 60.0)
        check(lost > 0, 'one packet of 1000 lost: noticed')
        share = lost / (lost + published)
        check(0.12 <= share <= 0.35, '%.0f %% of the frames lost, expected 23 %%' % (100 * share))
        check(abs(incomplete - lost) <= max(5, lost // 10), 'lost frames are those that came incomplete')
        check(node.images >= 50 and node.broken == 0, 'of %d images looked at %d are broken' % (node.images, node.broken))
        node.close()
        camera.kill()

        camera.start()
        node = Node(rospy, width=640, height=480)
        node.wait_frames(5)
        slowest, first = 0.0, None
        for cycle in range(options.cycles):
            warned, streaming = recovery(node, camera, 'cycle', camera.kill, camera.start)
            slowest = max(slowest, streaming)
            # What the dead camera held is let go of after a while.
            if cycle == min(4, options.cycles - 1):
                time.sleep(12.0)
                first = node.resources()
        time.sleep(12.0)
        last = node.resources()
        print('      after 5 cycles %.1f MB, %d threads, %d files; at the end %.1f MB, %d threads, %d files' % (first + last))
        check(slowest <= 5.0, '%d reconnections, the slowest %.2f s' % (options.cycles, slowest))
        check(last[0] <= first[0] + 10.0 and last[1:] == first[1:], 'and none leaks')
        check(node.close() < 5.0, 'the node ends at once')
        camera.kill()
        node = None
    finally:
        if node and node.process.poll() is None:
            node.process.kill()
        camera.kill()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--minutes', type=float, default=10.0, help='of undisturbed streaming')
    parser.add_argument('--cycles', type=int, default=50, help='of losing the camera and finding it again')
    options = parser.parse_args()
    foreign_camera.skip_without_camera()
    foreign_camera.enter_own_network()
    with foreign_camera.Master():
        endure(options)
    print('%d bounds do not hold' % len(failures) if failures else 'all bounds hold')
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
