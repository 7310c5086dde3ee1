#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""The demo without a screen, as a new user starts it: it ends well and in time, leaves what it promises, its console
and the logs of its nodes tell of no warning or error, and its recording is read where this package is not known.
Usage: demo_test.py SOURCE BUILD. Only with OMNISTER_FULL_TESTS=ON, since it takes minutes."""
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

PROMISED = ['lens.yaml', 'cloud.ply', 'range.tiff', 'run.bag', 'cloud.png']
COMPLAINT = re.compile(r'\[ ?WARN\]|\[ERROR\]|\[FATAL\]|Traceback|process has died|failed', re.I)
STANDARD = {'/camera/image_raw': 'sensor_msgs/Image', '/camera/camera_info': 'sensor_msgs/CameraInfo',
            '/camera/points2': 'sensor_msgs/PointCloud2', '/camera/range': 'sensor_msgs/Image',
            '/stage/joint_states': 'sensor_msgs/JointState', '/tf': 'tf2_msgs/TFMessage'}
# Reads with the messages of Debian alone.
READER = '''
import sys
import rosbag
try:
    import omnister.msg
    raise SystemExit('the package is in the way of this test')
except ImportError:
    pass
with rosbag.Bag(sys.argv[1]) as bag:
    for topic, message, _ in bag.read_messages(topics=sys.argv[2:]):
        print(topic, message._type, len(getattr(message, 'data', b'')))
'''


def main():
    source, build = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    if os.environ.get('OMNISTER_FULL_TESTS') != 'ON':
        print('left out: the demo takes minutes (OMNISTER_FULL_TESTS=ON runs it)')
        return 77
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / 'out'
        done = subprocess.run([str(source / 'run'), 'exec', '/usr/bin/python3', str(source / 'scripts/demo.py'),
                               '--headless', '--out', str(out)], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT, env=dict(os.environ, OMNISTER_BUILD_DIR=str(build)))
        console = done.stdout.decode('utf-8', 'replace')
        print(console)
        assert done.returncode == 0, 'exit code %d' % done.returncode
        complaints = [line for line in console.splitlines() if COMPLAINT.search(line)]
        assert not complaints, 'the console complains:\n' + '\n'.join(complaints)
        for promised in PROMISED:
            assert (out / promised).stat().st_size > 1000, promised

        environment = {key: value for key, value in os.environ.items()
                       if key not in ('PYTHONPATH', 'CMAKE_PREFIX_PATH', 'ROS_PACKAGE_PATH')}
        seen = {}
        for line in subprocess.run(['/usr/bin/python3', '-c', READER, str(out / 'run.bag'), *STANDARD], check=True,
                                   env=environment, stdout=subprocess.PIPE).stdout.decode().splitlines():
            topic, kind, _ = line.split()
            seen[topic] = kind
        assert seen == STANDARD, 'read without the package: %s' % seen
        print('ok: the recording is read without the package')
    return 0


if __name__ == '__main__':
    sys.exit(main())
