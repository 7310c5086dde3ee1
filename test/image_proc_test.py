#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""An ordinary node works with our camera_info: image_proc rectifies images of the camera node by its `equidistant` model, and
every pixel shows what the lens surface says it must. Usage: image_proc_test.py SOURCE BUILD"""
import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

LAUNCH = '''<launch>
  <include file="{source}/launch/camera.launch">
    <arg name="device" value="replay:{folder}/images"/>
    <arg name="lens" value="{lens}"/>
    <arg name="frame_rate" value="2"/>
    <arg name="loop" value="true"/>
  </include>
  <node ns="camera" name="rectify" pkg="image_proc" type="image_proc" output="screen"/>
</launch>
'''


def pixels(message):
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, -1).astype(float)


def sample(image, uv):
    """Bilinear."""
    at = np.floor(uv).astype(int)
    part = uv - at
    result = 0.0
    for dv in (0, 1):
        for du in (0, 1):
            weight = (part[:, 0] if du else 1 - part[:, 0]) * (part[:, 1] if dv else 1 - part[:, 1])
            result = result + weight[:, None] * image[at[:, 1] + dv, at[:, 0] + du]
    return result


def compare(info, raw, rectified, project):
    """Grey levels between what image_proc shows and what the lens says, and the same one pixel beside it."""
    P = np.array(info.P).reshape(3, 4)
    u, v = np.meshgrid(np.arange(20, rectified.shape[1] - 20, 10), np.arange(20, rectified.shape[0] - 20, 10))
    u, v = u.ravel(), v.ravel()
    rays = np.stack([(u - P[0, 2]) / P[0, 0], (v - P[1, 2]) / P[1, 1], np.ones(len(u))], axis=1)
    uv = project(rays)
    inside = np.all((uv >= 1) & (uv < [raw.shape[1] - 3, raw.shape[0] - 2]), axis=1)
    uv, shown = uv[inside], rectified[v[inside], u[inside]]
    return len(uv), [np.median(np.abs(sample(raw, uv + [shift, 0]) - shown).max(axis=1)) for shift in (0, 1)]


def main():
    source, build = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    run = str(source / 'run')
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ.update(OMNISTER_BUILD_DIR=str(build), ROS_MASTER_URI='http://localhost:%d' % port,
                          ROS_HOSTNAME='localhost', ROS_HOME=name, ROS_LOG_DIR=name)
        if subprocess.run([run, 'exec', 'rospack', 'find', 'image_proc'], stdout=subprocess.DEVNULL,
                          stderr=subprocess.DEVNULL).returncode != 0:
            print('left out: image_proc (ros-image-proc, libimage-proc-dev) is not installed')
            return 77
        lens = source / 'config/demo/lens.yaml'
        (folder / 'images').mkdir()
        subprocess.run([run, 'exec', 'omnister', 'render', '--lens', str(lens), '--scene',
                        str(source / 'config/scenes/room.yaml'), '--pose', '0 0 0 0 0 0 1', '--out',
                        str(folder / 'images/0.png')], check=True, stdout=subprocess.DEVNULL)
        (folder / 'test.launch').write_text(LAUNCH.format(source=source, folder=folder, lens=lens))
        with open(folder / 'roslaunch.log', 'wb') as log:
            launch = subprocess.Popen([run, 'exec', 'roslaunch', '-p', str(port), str(folder / 'test.launch')],
                                      stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
        import rosgraph
        import rospy
        from sensor_msgs.msg import CameraInfo, Image
        try:
            while not rosgraph.is_master_online():
                if launch.poll() is not None:
                    raise SystemExit('roslaunch ended:\n' + (folder / 'roslaunch.log').read_text())
                rospy.rostime.wallsleep(0.2)
            rospy.init_node('image_proc_test', disable_signals=True)
            rectified = pixels(rospy.wait_for_message('/camera/image_rect_color', Image, 120))
            raw = pixels(rospy.wait_for_message('/camera/image_raw', Image, 120))
            info = rospy.wait_for_message('/camera/camera_info', CameraInfo, 120)
        except rospy.ROSException as problem:
            raise SystemExit('%s; roslaunch said:\n%s' % (problem, (folder / 'roslaunch.log').read_text(errors='replace')))
        finally:
            os.killpg(launch.pid, signal.SIGINT)
            launch.wait()

        def project(rays):
            text = '\n'.join('%.12g %.12g %.12g' % tuple(ray) for ray in rays)
            done = subprocess.run([run, 'exec', 'omnister', 'project', '--lens', str(lens)], input=text,
                                  check=True, stdout=subprocess.PIPE, universal_newlines=True)
            return np.array([[float(word) for word in line.split()] for line in done.stdout.splitlines()])

        assert info.distortion_model == 'equidistant', info.distortion_model
        count, (apart, beside) = compare(info, raw, rectified, project)
        print('%d pixels: %.2f grey levels apart in the median, %.2f one pixel beside' % (count, apart, beside))
        assert count > 1000, count
        # Rounding alone is a quarter of a level on average, and image_proc's table of weights is coarse.
        assert apart < 1.0, apart
        assert beside > 3.0, beside
    return 0


if __name__ == '__main__':
    sys.exit(main())
