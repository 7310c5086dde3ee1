# SPDX-License-Identifier: Apache-2.0
"""A camera that nobody here wrote (Debian's arv-fake-gv-camera-0.8), for programs that measure our driver on it."""
import os
import shutil
import signal
import subprocess
import sys

CAMERA = 'arv-fake-gv-camera-0.8'


class Camera:
    def __init__(self, address='127.0.0.1', serial='ENDURE'):
        self.address, self.serial = address, serial
        self.process = None

    def start(self, lost_per_thousand=0):
        self.process = subprocess.Popen([CAMERA, '-i', self.address, '-s', self.serial, '-r', str(lost_per_thousand)],
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def signal(self, number):
        self.process.send_signal(number)

    def kill(self):
        if self.process:
            self.process.kill()
            self.process.wait()
            self.process = None


def skip_without_camera():
    if shutil.which(CAMERA) is None:
        print('skipped: %s is not installed (aravis-tools)' % CAMERA, file=sys.stderr)
        sys.exit(77)


def enter_own_network():
    """Starts this program again in a network of its own, where nobody else's cameras are, if that is allowed."""
    if 'FOREIGN_CAMERA' in os.environ or not shutil.which('unshare') or not shutil.which('ip'):
        return
    alone = ['unshare', '-n'] if os.getuid() == 0 else ['unshare', '-rn']
    if subprocess.call(alone + ['true'], stderr=subprocess.DEVNULL) == 0:
        os.environ['FOREIGN_CAMERA'] = 'own network'
        os.execvp('unshare', alone + ['sh', '-c', 'ip link set lo up && ip addr add 127.0.0.2/8 dev lo && exec "$@"', 'sh', sys.executable] + sys.argv)


class Master:
    """roscore, as long as the `with` lasts."""

    def __enter__(self):
        os.environ['ROS_MASTER_URI'] = 'http://localhost:11311'
        os.environ['ROS_HOSTNAME'] = 'localhost'
        self.process = subprocess.Popen(['roscore'], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        import rosgraph
        while not rosgraph.is_master_online():
            if self.process.poll() is not None:
                raise RuntimeError('roscore does not start')
        return self

    def __exit__(self, *ignored):
        self.process.send_signal(signal.SIGINT)
        self.process.wait()
