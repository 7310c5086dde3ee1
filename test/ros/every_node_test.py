#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Every program that the package calls a node, together as a rig: what each offers, that the lazy ones are lazy, that
services and parameters answer, that each comes back after it was killed and ends well when it is asked to."""
import contextlib
import itertools
import os
import re
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
import unittest
from pathlib import Path

import roslib.packages
import rosgraph
import rospy
import rostest
from actionlib_msgs.msg import GoalID, GoalStatusArray
from diagnostic_msgs.msg import DiagnosticArray
from dynamic_reconfigure.srv import Reconfigure
from geometry_msgs.msg import TransformStamped
from roscpp.srv import GetLoggers
from sensor_msgs.msg import Image, PointCloud2
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
# catkin keeps the environment of the time of configuring, when a clean tree has no messages yet: they lie beside the nodes.
LIBRARIES = Path(roslib.packages.find_node('omnister', 'stage_node')[0]).resolve().parents[1]
sys.path[:0] = [str(ROOT / 'scripts'), str(ROOT / 'test' / 'rig'), str(LIBRARIES / 'python3' / 'dist-packages')]
import demo  # noqa: E402  (its hands on a rig: services and actions)

PATIENCE = 60.0  # until something is said never to happen [s]; no measure of speed
UNIT = 4.9609375e-7


class Program:
    """A node of the package. `offers` are its own topics and services, or those of what it holds in a `manager`;
    `wrong` is a parameter and a value that it refuses, or none where it takes no parameters."""

    def __init__(self, name, offers, parameters=(), remap=(), wrong=None, arguments=(), manager=None):
        self.name, self.offers, self.wrong, self.speaker = name, offers, wrong, manager or name
        self.arguments = list(arguments) + ['_%s:=%s' % item for item in dict(parameters).items()] + \
            ['%s:=%s' % item for item in remap]
        self.process = None
        self.output = b''

    def command(self, kind):
        space, _, name = self.name.rpartition('/')
        return [roslib.packages.find_node('omnister', kind)[0], '__ns:=' + (space or '/'), '__name:=' + name]

    def start(self, kind, *more, environment=None):
        self.output = b''
        self.process = subprocess.Popen(self.command(kind) + self.arguments + list(more), stdin=subprocess.DEVNULL,
                                        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment)
        self.reader = threading.Thread(target=self.read, args=(self.process.stdout,), daemon=True)
        self.reader.start()

    def read(self, stream):
        with stream:
            for line in stream:
                self.output += line

    def most_memory(self):
        """Ever resident [MB]."""
        status = Path('/proc/%d/status' % self.process.pid).read_text()
        return int(re.search(r'^VmHWM:\s+(\d+) kB', status, re.M).group(1)) / 1024.0

    def end(self, sign, seconds=PATIENCE):
        """@return its exit code; None when it does not end"""
        self.process.send_signal(sign)
        return self.wait(seconds)

    def wait(self, seconds=PATIENCE):
        try:
            code = self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return None
        self.reader.join(seconds)
        return code


def programs(work):
    """By the name of the executable, in the order in which a person would start them."""
    lens, port = ROOT / 'test/rig/lens.yaml', work / 'stage'
    stage = [(topic, '/stage/' + topic) for topic in ('stage_state', 'move_stage')]
    return {
        'sim_rig_node': Program(
            '/hardware', ['/hardware/show_board'],
            {'scene': ROOT / 'config/scenes/room.yaml', 'boards': ROOT / 'config/scenes/calibration_board.yaml',
             'lens': lens, 'travel': 0.4, 'homed': 'true', 'homing_speed': 0.4, 'adaptive': 'true', 'supersampling': 1,
             'noise': 1.0, 'port': port, 'camera_serial': 'every-node', 'frame_rate': 5}, wrong=('travel', 'far')),
        'stage_node': Program(
            '/stage/driver', ['/stage/' + name for name in (
                'stage_state', 'joint_states', 'home', 'halt', 'recover', 'move_stage/result')],
            {'device': 'zaber:%s' % port, 'unit_m': UNIT, 'max_m': 0.4, 'speed_mps': 0.2, 'axis': '0 -1 0',
             'retry_period': 0.2}, wrong=('speed_mps', -1)),
        'stage_marker_node': Program(
            '/stage/marker', ['/stage/stage_marker/update', '/stage/move_stage/goal'], {'max_m': 0.4},
            wrong=('max_m', 'far')),
        'camera_node': Program(
            '/camera/driver', ['/camera/' + name for name in (
                'image_raw', 'camera_info', 'lens_model', 'set_camera_info', 'list_lenses', 'roll_back_lens', 'trigger')],
            {'device': 'aravis:every-node', 'lens': lens, 'store': work / 'store', 'frame_rate': 5, 'retry_period': 0.2,
             'parent_frame_id': 'stage_carriage'}, wrong=('frame_rate', -5)),
        'stereo_node': Program(
            '/camera/stereo', ['/camera/' + name for name in ('points2', 'depth', 'range', 'epipolar', 'timing')],
            {'min_baseline': 0.05, 'max_baseline': 0.3, 'max_range': 12}, wrong=('matcher', 'magic')),
        'view_node': Program(
            '/camera/view_node', ['/camera/view/' + name for name in ('image_raw', 'camera_info', 'depth/image_raw')],
            {'width': 160, 'height': 120}, wrong=('hfov', -1)),
        'calibration_node': Program(
            '/camera/calibration', ['/camera/coverage', '/camera/residuals', '/camera/calibrate/result'] +
            ['/camera/calibration/' + name for name in ('start', 'save', 'reset')],
            {'target': ROOT / 'config/demo/target.yaml', 'store': work / 'store'}, wrong=('views', -1)),
        'scan_node': Program(
            '/camera/scan', ['/camera/stage_frames', '/camera/scan/image_raw', '/camera/scan/result'],
            {'folder': work / 'scans', 'stop_timeout': 60}, stage, wrong=('settle_time', -1)),
        'snapshot_node': Program(
            '/camera/snapshot', ['/camera/snapshot/save'],
            {'cloud': work / 'cloud.ply', 'range': work / 'range.tiff', 'timeout': 60}, wrong=('timeout', -1)),
        'doctor_node': Program('/watch', ['/diagnostics'], arguments=['--watch', '--camera', '/camera', '--seconds', '1',
                                                                      '--period', '0.5']),
        # It has nothing of its own: it holds a nodelet in a manager.
        'nodelet_node': Program('/other/view_node', ['/other/view/image_raw', '/other/view/depth/image_raw'],
                                arguments=['omnister/ViewNodelet', '/manager'], manager='/manager'),
    }


def eventually(condition, seconds=PATIENCE):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(OSError, rosgraph.MasterException):
            if condition():
                return True
        time.sleep(0.05)
    return bool(condition())


class Graph:
    """Who publishes, hears and serves what, as the master tells."""

    def __init__(self):
        state = rosgraph.Master('/every_node').getSystemState()
        self.published, self.heard, self.served = [{name: set(nodes) for name, nodes in part} for part in state]

    def offers(self, node, name):
        return node in self.published.get(name, ()) or node in self.served.get(name, ())

    def hears(self, node, topic):
        return node in self.heard.get(topic, ())


class EveryNode(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.stack = contextlib.ExitStack()
        cls.addClassCleanup(cls.stack.close)
        cls.work = Path(cls.stack.enter_context(tempfile.TemporaryDirectory(prefix='omnister_every_node_')))
        cls.rig = demo.Rig(demo.Clock(None))
        cls.states = {}
        rospy.Subscriber('/diagnostics', DiagnosticArray, cls.on_diagnostics, queue_size=100)
        cls.programs = programs(cls.work)
        cls.stack.callback(cls.kill_all)
        for kind, program in cls.programs.items():
            program.start(kind)

    @classmethod
    def kill_all(cls):
        for program in cls.programs.values():
            if program.process and program.process.poll() is None:
                program.end(signal.SIGKILL)

    @classmethod
    def on_diagnostics(cls, array):
        for status in array.status:
            cls.states[status.name.rsplit(' ', 1)[-1]] = {value.key: value.value for value in status.values}

    def offered(self, kind):
        return not self.missing(kind)

    def missing(self, kind):
        program, graph = self.programs[kind], Graph()
        return [name for name in program.offers if not graph.offers(program.speaker, name)]

    def all_are_there(self):
        for kind in self.programs:
            self.assertTrue(eventually(lambda: self.offered(kind)), '%s lacks %s; it said: %s' % (
                kind, self.missing(kind), self.programs[kind].output.decode()[-2000:]))

    @contextlib.contextmanager
    def listener(self, topic, kind):
        came = []
        subscriber = rospy.Subscriber(topic, kind, came.append, queue_size=1, buff_size=1 << 25)
        try:
            yield came
        finally:
            subscriber.unregister()

    def rests(self):
        """The stage, by a reading from now on."""
        since = rospy.Time.now()

        def holds():
            state = self.rig.stage_state
            return state.header.stamp > since and state.homed and not state.moving and not state.fault

        self.assertTrue(eventually(holds), self.rig.stage_state)

    def a_cloud(self):
        """Of two places."""
        with self.listener('/camera/points2', PointCloud2) as clouds:
            self.rig.act('/camera/scan', 'Scan', self.rig.msg.ScanGoal(positions=[0.05, 0.2]), PATIENCE)
            self.assertTrue(eventually(lambda: clouds))

    def test_1_every_program_is_tried(self):
        built = re.findall(r'^omnister_add_node\(\w+ (\w+)\)', (ROOT / 'src/ros/CMakeLists.txt').read_text(), re.M)
        self.assertEqual(sorted(built), sorted(self.programs))
        nodelets = re.findall(r'class name="omnister/(\w+)"', (ROOT / 'nodelet_plugins.xml').read_text())
        come_and_go = (HERE / 'nodes_test.cpp').read_text()
        for nodelet in nodelets:
            self.assertIn('TEST(%s, ComesAndGoesAHundredTimes)' % nodelet, come_and_go)

    def test_2_each_offers_what_it_should(self):
        self.all_are_there()

    def test_3_what_is_lazy_works_only_while_someone_listens(self):
        def state():
            return self.states.get('camera', {}).get('state')

        self.assertTrue(eventually(lambda: state() == 'idle'), state())
        for node, output, kind in (('/camera/stereo', '/camera/points2', PointCloud2),
                                   ('/camera/view_node', '/camera/view/image_raw', Image)):
            for _ in range(2):
                self.assertTrue(eventually(lambda: not Graph().hears(node, '/camera/image_raw')), node)
                with self.listener(output, kind):
                    self.assertTrue(eventually(lambda: Graph().hears(node, '/camera/image_raw')), node)
                    self.assertTrue(eventually(lambda: state() == 'streaming'), state())
        self.assertTrue(eventually(lambda: state() == 'idle'), state())

    def test_4_services_and_actions_answer(self):
        self.rig.call('/stage/recover', Trigger)
        self.rig.call('/stage/home', Trigger)
        self.rests()
        self.rig.call('/hardware/show_board', SetBool, True)
        self.rig.call('/hardware/show_board', SetBool, False)
        self.rig.call('/camera/calibration/reset', Trigger)
        with self.assertRaisesRegex(demo.Failure, 'view'):
            self.rig.call('/camera/calibration/save', Trigger)
        saved = []
        with self.listener('/camera/points2', PointCloud2):
            asking = threading.Thread(target=lambda: saved.append(self.rig.call('/camera/snapshot/save', Trigger)))
            asking.start()
            self.assertTrue(eventually(lambda: Graph().hears('/camera/snapshot', '/camera/range')))
            while asking.is_alive():
                self.a_cloud()
                asking.join(1.0)
        self.assertRegex(saved[0], r'^[1-9]\d* points of ')
        self.assertGreater((self.work / 'cloud.ply').stat().st_size, 10000)
        self.assertGreater((self.work / 'range.tiff').stat().st_size, 10000)
        self.rig.call('/stage/halt', Trigger)

    def test_4_stamps_that_ros_cannot_reckon_with_end_nothing(self):
        end = Header(stamp=rospy.Time(4294967295, 999999999), frame_id='stage_base')
        cancels = ['/stage/move_stage/cancel', '/camera/calibrate/cancel', '/camera/scan/cancel']
        hostile = [(topic, GoalID(stamp=end.stamp, id='never')) for topic in cancels]
        transform = TransformStamped(header=end, child_frame_id='nowhere')
        transform.transform.rotation.w = 1.0
        hostile.append(('/tf', TFMessage([transform])))
        # A frame above the fixed one, in a loop at that, and the carriage an hour ahead of its time.
        for frame, child, ahead in (('camera_optical', 'stage_base', 0), ('stage_base', 'stage_carriage', 3600)):
            stray = TransformStamped(header=Header(stamp=rospy.Time.now() + rospy.Duration(ahead), frame_id=frame),
                                     child_frame_id=child)
            stray.transform.rotation.w = 1.0
            hostile.append(('/tf', TFMessage([stray])))
        hostile.append(('/stage/stage_state', self.rig.msg.StageState(header=end)))
        publishers = []
        for topic, message in hostile:
            publisher = rospy.Publisher(topic, type(message), queue_size=1)
            heard = Graph().heard[topic]
            self.assertTrue(eventually(lambda: publisher.get_num_connections() >= len(heard)), topic)
            publisher.publish(message)
            if topic in cancels:
                with self.listener(topic[:-len('cancel')] + 'status', GoalStatusArray) as came:
                    self.assertTrue(eventually(lambda: len(came) > 3), topic)
            publishers.append(publisher)
        self.a_cloud()
        for kind, program in self.programs.items():
            self.assertIsNone(program.process.poll(), kind)
        for publisher in publishers:
            publisher.unregister()

    def test_4_the_log_of_every_node_can_be_asked_for(self):
        """What rqt_logger_level does; Debian's own answer destroys the log, and the next line of it ends the node."""
        for speaker in [program.name for program in self.programs.values()] + ['/manager']:
            ask = rospy.ServiceProxy(speaker + '/get_loggers', GetLoggers)
            for _ in range(3):
                self.assertIn('ros', [logger.name for logger in ask().loggers], speaker)
        for kind, program in self.programs.items():
            self.assertIsNone(program.process.poll(), kind)

    def test_4_arrays_longer_than_their_message_take_no_memory(self):
        def lying(kind, before, count):
            """Of that type by name and sum; its bytes end with the length of an array that does not come."""
            def serialize(self, buffer):
                buffer.write(before + struct.pack('<I', count))
            return type(kind.__name__, (kind,), {'serialize': serialize})

        header, goal_id = b'\0' * 16, b'\0' * 12
        image = header + struct.pack('<II', 300, 400) + struct.pack('<I', 5) + b'mono8' + b'\0' + struct.pack('<I', 400)
        # What is claimed would fill a gigabyte.
        messages = [('/camera/image_raw', Image, image, 1 << 30), ('/tf', TFMessage, b'', 1 << 23),
                    ('/tf_static', TFMessage, b'', 1 << 23),
                    ('/stage/move_stage/status', GoalStatusArray, header, 1 << 24),
                    ('/camera/scan/goal', self.rig.msg.ScanActionGoal, header + goal_id, (1 << 29) + 1)]
        calls = [('/camera/view_node/set_parameters', Reconfigure, b'', 1 << 24),
                 ('/camera/stereo/set_parameters', Reconfigure, b'', 1 << 24),
                 ('/camera/set_camera_info', SetCameraInfo, header + b'\0' * 12, 1 << 27)]
        before = {kind: program.most_memory() for kind, program in self.programs.items()}
        with self.listener('/camera/view/image_raw', Image), self.listener('/camera/points2', PointCloud2):
            for node in ('/camera/view_node', '/camera/stereo'):
                self.assertTrue(eventually(lambda: Graph().hears(node, '/camera/image_raw')), node)
            for topic, kind, body, count in messages:
                publisher = rospy.Publisher(topic, lying(kind, body, count), queue_size=1)
                heard = Graph().heard[topic]
                self.assertTrue(eventually(lambda: publisher.get_num_connections() >= len(heard)), topic)
                publisher.publish(publisher.data_class())
                # That it was taken in, by word of who is asked next on the same connection or thread.
                rospy.sleep(0.2)
                publisher.unregister()
            for service, kind, body, count in calls:
                class Lying(kind):
                    _request_class = lying(kind._request_class, body, count)
                with self.assertRaises(rospy.ServiceException):
                    rospy.ServiceProxy(service, Lying)(Lying._request_class())
        self.a_cloud()
        for kind, program in self.programs.items():
            self.assertIsNone(program.process.poll(), kind)
            self.assertLess(program.most_memory() - before[kind], 500.0, kind)

    def test_5_files_that_parameters_name_are_refused_by_the_parameters_name(self):
        refused = 0
        for kind, key, value in (('camera_node', 'lens', '/no/lens.yaml'), ('camera_node', 'device', 'webcam'),
                                 ('stereo_node', 'mask', '/no/mask.png'), ('stereo_node', 'lens', '/dev/null'),
                                 ('view_node', 'lens', '/no/lens.yaml'), ('calibration_node', 'target', '/no/board.yaml'),
                                 ('sim_rig_node', 'scene', '/no/scene.yaml'), ('snapshot_node', 'cloud', 'cloud.txt')):
            beside = Program('/refused/%s_%s' % (kind, key), [], arguments=self.programs[kind].arguments)
            beside.start(kind, '_%s:=%s' % (key, value))
            self.assertEqual(beside.wait(), 1, kind)
            self.assertIn('parameter %s/%s: ' % (beside.name, key), beside.output.decode())
            refused += 1
        self.assertEqual(refused, 8)

    def test_5_a_wrong_parameter_is_refused_by_name(self):
        refused = 0
        for kind, program in self.programs.items():
            if program.wrong is None:
                continue
            key, value = program.wrong
            beside = Program(program.name + '_wrong', [], arguments=program.arguments)
            beside.start(kind, '_%s:=%s' % (key, value))
            self.assertEqual(beside.wait(), 1, kind)
            self.assertIn(key, beside.output.decode(), kind)
            refused += 1
        self.assertEqual(refused, 9)
        other = Program('/camera/wrong', [], arguments=['omnister/NoNodelet', '/manager'])
        other.start('nodelet_node')
        self.assertEqual(other.wait(), 1)
        self.assertIn('NoNodelet', other.output.decode())

    def test_5_calibration_has_a_store_without_being_told_where(self):
        alone = Program('/at_home/calibration', ['/at_home/coverage'],
                        {'target': ROOT / 'config/demo/target.yaml', 'store': ''})
        self.stack.callback(lambda: alone.process.poll() is None and alone.end(signal.SIGKILL))
        alone.start('calibration_node', environment=dict(os.environ, ROS_HOME=str(self.work)))
        self.assertTrue(eventually(lambda: Graph().offers(alone.name, '/at_home/coverage')), alone.output.decode())
        self.assertEqual(alone.end(signal.SIGINT), 0, alone.output.decode())

    def test_5_names_that_ros_does_not_take_are_refused(self):
        refused = 0
        for kind, program in self.programs.items():
            beside = Program('/a b/node', [], arguments=program.arguments)
            beside.start(kind)
            self.assertEqual(beside.wait(), 1, kind)
            self.assertRegex(beside.output.decode(), r'(?i)^\w+: .*name', kind)
            beside = Program('/node', [], arguments=program.arguments)
            beside.start(kind, environment=dict(os.environ, ROS_MASTER_URI='nonsense'))
            self.assertEqual(beside.wait(), 1, kind)
            self.assertIn('ROS_MASTER_URI: is "nonsense"', beside.output.decode(), kind)
            refused += 1
        self.assertEqual(refused, 11)

    def test_5_each_ends_while_it_waits_for_the_master(self):
        nowhere = dict(os.environ, ROS_MASTER_URI='http://127.0.0.1:%d/' % demo.free_port())
        ended = 0
        for sign, kind in zip(itertools.cycle((signal.SIGINT, signal.SIGTERM, signal.SIGHUP)), self.programs):
            # Nodes with parameters wait for it where ROS sets those, and are ended there by any signal.
            alone = Program('/alone', [], arguments=[word for word in self.programs[kind].arguments if ':=' not in word])
            alone.start(kind, environment=nowhere)
            self.assertTrue(eventually(lambda: b'master' in alone.output), kind)
            self.assertIn(alone.end(sign), (0, -sign), '%s: %s' % (kind, alone.output.decode()))
            ended += 1
        self.assertEqual(ended, 11)

    def test_6_what_was_killed_starts_anew_beside_the_others(self):
        for program in self.programs.values():
            program.end(signal.SIGKILL)
        for kind, program in self.programs.items():
            program.start(kind)
        self.all_are_there()
        self.rests()
        self.a_cloud()

    def test_7_each_ends_when_it_is_asked_to(self):
        ended = 0
        # The second is what systemd sends, the third comes of a terminal that is closed.
        signs = itertools.cycle((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
        for sign, (kind, program) in zip(signs, reversed(list(self.programs.items()))):
            code = program.end(sign)
            self.assertEqual(code, 0, '%s: %s' % (kind, program.output.decode()[-2000:]))
            self.assertTrue(eventually(lambda: len(self.missing(kind)) == len(program.offers)), kind)
            ended += 1
        self.assertEqual(ended, 11)


if __name__ == '__main__':
    rostest.rosrun('omnister', 'every_node_test', EveryNode, sys.argv)
