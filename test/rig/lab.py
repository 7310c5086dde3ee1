# SPDX-License-Identifier: Apache-2.0
"""The simulated rig in a network of its own, seen from outside: its topics, diagnostics and processes. For
tests that run it for long (soak.py) or break it (faults.py)."""
import collections
import contextlib
import glob
import os
import re
import signal
import socket
import sys
import tempfile
import time
import xmlrpc.client
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1] / 'scripts')]
import demo  # noqa: E402  (its processes, its clock and its hands on the rig)
import foreign_camera  # noqa: E402

SKIPPED = 77
VIEWS = '/camera/view/camera_info'
NODES = ['/rig', '/manager', '/stage/driver', '/camera/scan', '/watch']


def own_network():
    """Runs this program again in a network where nobody else's cameras and masters are. Returns there; a program that is
    asked to end then ends what it began."""
    foreign_camera.enter_own_network()
    if [name for _, name in socket.if_nameindex()] != ['lo']:
        print('skipped: a network of its own cannot be had here (unshare -n, ip)', file=sys.stderr)
        sys.exit(SKIPPED)
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))


def resources(pid):
    """Resident memory [MB], open files and threads of a process; None when it is gone."""
    try:
        status = Path('/proc/%d/status' % pid).read_text()
        return (int(re.search(r'VmRSS:\s+(\d+)', status).group(1)) / 1024.0,
                len(os.listdir('/proc/%d/fd' % pid)), int(re.search(r'Threads:\s+(\d+)', status).group(1)))
    except (OSError, AttributeError):
        return None


class Watcher:
    """What everybody can see of a running rig."""

    def __init__(self, rospy):
        import omnister.msg
        from diagnostic_msgs.msg import DiagnosticArray
        self.rospy = rospy
        self.levels = {}     # of each diagnostic, by the last part of its name
        self.messages = {}
        self.values = collections.defaultdict(dict)
        self.history = []    # (time, diagnostic, level, message) at each change
        self.seen = {}       # time of the last message of each topic
        self.times = collections.defaultdict(lambda: collections.deque(maxlen=3000))
        self.counts = collections.Counter()
        self.missed = collections.Counter()
        self.numbers = {}
        self.ages = []       # (time, age) of each cloud
        self.stage = None
        self.logs = []       # (time, node, text) of warnings and worse
        self.checks = []     # called with each diagnostic as it comes
        rospy.Subscriber('/diagnostics', DiagnosticArray, self.on_diagnostics, queue_size=200)
        rospy.Subscriber('/camera/timing', omnister.msg.StageTimes, self.on_timing, queue_size=100)
        rospy.Subscriber('/stage/stage_state', omnister.msg.StageState, self.on_stage, queue_size=100)
        self.listen('/camera/points2', buff_size=1 << 25)
        self.listen(VIEWS)

    def listen(self, topic, **more):
        return self.rospy.Subscriber(topic, self.rospy.AnyMsg, self.on_any, topic, queue_size=10, **more)

    def on_any(self, message, topic):
        # Messages with a header begin with their number.
        number = int.from_bytes(message._buff[:4], 'little')
        last = self.numbers.get(topic)
        if last is not None and number > last:
            self.missed[topic] += number - last - 1
        self.numbers[topic] = number
        self.count(topic)

    def count(self, topic):
        self.counts[topic] += 1
        self.seen[topic] = time.monotonic()
        self.times[topic].append(self.seen[topic])

    def longest_gap(self, topic, since):
        """Between messages, from the last one before on [s]."""
        times = list(self.times[topic])
        before = [when for when in times if when <= since][-1:]
        times = before + [when for when in times if when > since]
        return max((b - a for a, b in zip(times, times[1:])), default=0.0)

    def on_timing(self, times):
        self.ages.append((time.monotonic(), times.age))
        self.counts['timing'] += 1

    def on_stage(self, state):
        self.stage = state
        self.count('stage')

    def on_diagnostics(self, array):
        now = time.monotonic()
        for status in array.status:
            name = status.name.rsplit(' ', 1)[-1]
            level = status.level if isinstance(status.level, int) else status.level[0]
            if (self.levels.get(name), self.messages.get(name)) != (level, status.message):
                self.history.append((now, name, level, status.message))
            self.levels[name], self.messages[name] = level, status.message
            self.values[name] = {value.key: value.value for value in status.values}
            self.seen['diagnostic ' + name] = now
            for check in self.checks:
                check(name, self.values[name])

    def number(self, diagnostic, key):
        return float(self.values[diagnostic].get(key, '0'))


def start_master(processes, clock, port=None):
    """On a free port, which it returns, or on the one it had before."""
    port = port or demo.free_port()
    os.environ['ROS_MASTER_URI'] = 'http://127.0.0.1:%d/' % port
    processes.start('rosmaster', ['rosmaster', '--core', '-p', str(port)])

    def answers():
        with socket.socket() as probe:
            return probe.connect_ex(('127.0.0.1', port)) == 0

    clock.wait('the start of the ROS master', answers, 30.0)
    return port


class MachineClock:
    """The time of day of the rig's nodes. Its hardware, these tests and everybody else keep theirs."""

    def __init__(self, file):
        self.file = file
        self.set(0)

    @staticmethod
    def library():
        """Debian's libfaketime; None where it is not installed."""
        return next(iter(sorted(glob.glob('/usr/lib/*/faketime/libfaketimeMT.so.1'))), None)

    def set(self, seconds):
        """Ahead of the true time."""
        beside = self.file.with_suffix('.new')
        beside.write_text('%+d\n' % seconds)
        beside.rename(self.file)


class Lab:
    """`with Lab(...) as lab:` a running rig, its watcher and the hands on it; everything ends with it."""

    def __init__(self, log_folder=None, own_clock=False, **arguments):
        self.arguments = arguments
        self.own_clock = own_clock
        self.log_folder = log_folder
        self.faults = None
        self.port = None

    def __enter__(self):
        self.stack = contextlib.ExitStack()
        with contextlib.ExitStack() as stack:
            self.work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='omnister_lab_')))
            logs = Path(self.log_folder or self.work / 'log')
            logs.mkdir(parents=True, exist_ok=True)
            self.clock = demo.Clock(None)
            self.processes = demo.Processes(logs)
            stack.callback(self.processes.stop_all)
            demo.prepare_environment(self.work, False)
            self.start_master()
            import rospy
            self.rospy = rospy
            self.output = []  # (time, line) of what roslaunch and the nodes say
            if self.own_clock:
                self.machine_clock = MachineClock(self.work / 'clock')
                self.arguments.update(clock=self.machine_clock.file, clock_library=MachineClock.library())
            self.launch = self.processes.start(
                'roslaunch', ['roslaunch', '--skip-log-check', str(HERE / 'lab.launch'),
                              'work:=%s' % self.work] + ['%s:=%s' % item for item in self.arguments.items()],
                lambda line: self.output.append((time.monotonic(), line)))
            self.rig = demo.Rig(self.clock)
            self.watcher = Watcher(rospy)
            self.clock.wait('the first cloud', self.first_cloud, 180.0)
            self.stack = stack.pop_all()
        return self

    def __exit__(self, *_):
        self.rospy.signal_shutdown('done')
        self.stack.close()

    def start_master(self):
        self.port = start_master(self.processes, self.clock, self.port)

    def first_cloud(self):
        """Slides to and fro until one comes."""
        state = self.watcher.stage
        if state is not None and state.homed:
            with contextlib.suppress(demo.Failure):
                self.slide()
        return self.watcher.counts['timing'] > 0

    def slide(self, seconds=20.0):
        """Between two places a baseline apart; stays long enough for a settled image."""
        self.move(0.25 if self.watcher.stage.position < 0.15 else 0.05, seconds)
        self.pause(0.8)

    def move(self, position, seconds):
        self.rig.act('/stage/move_stage', 'MoveStage', self.rig.msg.MoveStageGoal(position=position), seconds)

    @staticmethod
    def pause(seconds):
        time.sleep(seconds)

    def fault(self, words):
        """Something goes wrong with the simulated hardware: see sim_rig.h."""
        if self.faults is None:
            from std_msgs.msg import String
            self.faults = self.rospy.Publisher('/rig/fault', String, queue_size=10)
        self.clock.wait('the simulated hardware', self.faults.get_num_connections, 20.0)
        self.faults.publish(words)

    def pid(self, node):
        """Of a node, asked of itself; None when it does not answer."""
        try:
            master = xmlrpc.client.ServerProxy(os.environ['ROS_MASTER_URI'])
            code, _, address = master.lookupNode('/lab', node)
            if code != 1:
                return None
            code, _, pid = xmlrpc.client.ServerProxy(address).getPid('/lab')
            return pid if code == 1 else None
        except (OSError, xmlrpc.client.Error):
            return None
