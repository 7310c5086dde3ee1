#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Runs the simulated rig from first light to cloud: homes the stage, calibrates the camera on a board that
is carried before it, scans the room, and shows or saves the result. It starts its own ROS master on a
free port, and ends every process it started, and only these."""

import argparse
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

HEADLESS_SECONDS = 170.0  # everything, start to end
BOARD_PATIENCE = 6.0  # before the board is held elsewhere though no view was taken [s]
REST = 8.0  # of the stage, until a scan that a hand interrupted goes on [s]
USUAL_PORT = 11311  # of a ROS master
POSITIONS = [0.0, 0.1, 0.2, 0.3, 0.4]  # of the scan [m]
ARTEFACTS = ['lens.yaml', 'cloud.ply', 'range.tiff', 'run.bag', 'cloud.png']
RECORDED = ['/camera/image_raw', '/camera/camera_info', '/camera/lens_model', '/camera/points2',
            '/camera/range', '/camera/stage_frames', '/stage/joint_states', '/stage/stage_state', '/tf', '/tf_static', '/diagnostics',
            '/rosout_agg']


class Failure(Exception):
    """What a person reads when the demo did not work out."""


class Clock:
    def __init__(self, seconds):
        self.start = time.monotonic()
        self.end = self.start + seconds if seconds else None

    def say(self, text):
        print('[%3.0f s] %s' % (time.monotonic() - self.start, text), flush=True)

    def wait(self, what, condition, seconds):
        """Polls until the condition holds and returns its value."""
        until = time.monotonic() + seconds
        if self.end:
            until = min(until, self.end)
        while True:
            value = condition()
            if value:
                return value
            if time.monotonic() > until:
                raise Failure('%s did not happen in time' % what)
            time.sleep(0.05)


class Processes:
    """Each in a session of its own, so that exactly it and its children can be ended."""

    def __init__(self, log_folder):
        self.log_folder = log_folder
        self.running = []

    def start(self, name, arguments, watch=None, **more):
        log = open(self.log_folder / (name + '.log'), 'wb')
        try:
            process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stderr=subprocess.STDOUT,
                                       stdout=subprocess.PIPE if watch else log,
                                       start_new_session=True, **more)
        except OSError as error:
            log.close()
            raise Failure('cannot start %s: %s' % (arguments[0], error.strerror))
        self.running.append((name, process))
        if watch:
            threading.Thread(target=self.copy, args=(process.stdout, log, watch), daemon=True).start()
        else:
            log.close()
        return process

    @staticmethod
    def copy(source, log, watch):
        with log:
            for line in source:
                log.write(line)
                log.flush()
                watch(line.decode('utf-8', 'replace').rstrip())

    def ended(self, name):
        return any(process.poll() is not None for known, process in self.running if known == name)

    def stop(self, name, seconds=15.0):
        for entry in [e for e in self.running if e[0] == name]:
            self.running.remove(entry)
            process = entry[1]
            for sign, patience in ((signal.SIGINT, seconds), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0)):
                try:
                    os.killpg(process.pid, sign)
                except ProcessLookupError:
                    break
                try:
                    process.wait(patience)
                    break
                except subprocess.TimeoutExpired:
                    continue

    def stop_all(self):
        for name, _ in reversed(list(self.running)):
            self.stop(name)


class Rig:
    """The running rig, seen through its topics, services and actions."""

    def __init__(self, clock):
        import rospy
        import omnister.msg
        from sensor_msgs.msg import Image, PointCloud2
        from std_srvs.srv import SetBool, Trigger
        self.rospy, self.msg, self.clock = rospy, omnister.msg, clock
        self.Image, self.PointCloud2, self.SetBool, self.Trigger = Image, PointCloud2, SetBool, Trigger
        rospy.init_node('demo', disable_signals=True)
        # When rviz is closed the master goes first; that this node cannot sign off is no news.
        logging.getLogger('rosout').setLevel(logging.ERROR)
        self.stage_state = None
        self.cloud_stamp = 0.0
        self.clouds = 0
        self.goals = 0
        rospy.Subscriber('/stage/stage_state', omnister.msg.StageState, self.on_stage)

    def on_stage(self, state):
        self.stage_state = state

    def on_cloud(self, cloud):
        self.cloud_stamp = cloud.header.stamp.to_sec()
        self.clouds += 1

    def watch_clouds(self):
        self.rospy.Subscriber('/camera/points2', self.PointCloud2, self.on_cloud, queue_size=1,
                              buff_size=1 << 25)

    def first_image(self):
        seen = []
        subscriber = self.rospy.Subscriber('/camera/image_raw', self.Image, seen.append, queue_size=1)
        try:
            return self.clock.wait('the first image', lambda: seen and seen[0], 60.0)
        finally:
            subscriber.unregister()

    def call(self, service, kind, *request):
        try:
            self.rospy.wait_for_service(service, 20.0)
            response = self.rospy.ServiceProxy(service, kind)(*request)
        except (self.rospy.ROSException, self.rospy.ServiceException) as error:
            raise Failure('service %s: %s' % (service, error))
        if not response.success:
            raise Failure('service %s: %s' % (service, response.message))
        return response.message

    def act(self, action, kind, goal, seconds, on_feedback=None):
        """Runs an action to its end. Spoken by topics, which is all an action is."""
        types = {part: getattr(self.msg, kind + part) for part in
                 ('ActionGoal', 'ActionResult', 'ActionFeedback')}
        self.goals += 1
        message = types['ActionGoal'](goal=goal)
        message.goal_id.id = 'demo-%d' % self.goals
        results = []

        def on_result(result):
            if result.status.goal_id.id == message.goal_id.id:
                results.append(result.result)

        def on_any_feedback(feedback):
            if on_feedback and feedback.status.goal_id.id == message.goal_id.id:
                on_feedback(feedback.feedback)

        ends = [self.rospy.Subscriber(action + '/result', types['ActionResult'], on_result),
                self.rospy.Subscriber(action + '/feedback', types['ActionFeedback'], on_any_feedback)]
        publisher = self.rospy.Publisher(action + '/goal', types['ActionGoal'], queue_size=1)
        try:
            self.clock.wait('the start of action %s' % action,
                            lambda: publisher.get_num_connections() and
                            all(end.get_num_connections() for end in ends), 20.0)
            message.header.stamp = message.goal_id.stamp = self.rospy.Time.now()
            publisher.publish(message)
            result = self.clock.wait('the end of action %s' % action, lambda: results and results[0],
                                     seconds)
        finally:
            for end in ends + [publisher]:
                end.unregister()
        if not result.success:
            raise Failure('%s: %s' % (action, result.message))
        return result

    def home(self):
        self.call('/stage/home', self.Trigger)
        self.clock.wait('homing of the stage',
                        lambda: self.stage_state and self.stage_state.homed and
                        not self.stage_state.moving, 30.0)

    def calibrate(self):
        """Plays the person who holds the board: still until a view of it is taken, then elsewhere."""
        told, held = [0], [0, 0.0]

        def on_feedback(feedback):
            if feedback.stage == 'fitting':
                self.clock.say('calibration: fitting the lens surface')
            if feedback.stage != 'collecting':
                return
            if feedback.views > held[0] or time.monotonic() - held[1] > BOARD_PATIENCE:
                held[:] = feedback.views, time.monotonic()
                self.call('/rig/show_board', self.SetBool, True)
            if feedback.views >= told[0] + 5:
                told[0] = feedback.views
                self.clock.say('calibration: %d views, %.0f %% of the image covered; next: %s' %
                               (feedback.views, 100.0 * feedback.coverage, feedback.hint))

        result = self.act('/camera/calibrate', 'Calibrate', self.msg.CalibrateGoal(timeout=90.0), 115.0,
                          on_feedback)
        self.call('/rig/show_board', self.SetBool, False)
        self.clock.say('calibration: %s, %d views, RMS %.3f px, %.3f px on unseen views, field of view %.0f deg' %
                       (result.model, result.views_used, result.rms_px, result.holdout_rms_px,
                        2.0 * 57.29578 * result.max_theta))
        return result.lens_file

    def wait_for_rest(self, seconds):
        since = time.monotonic()
        while time.monotonic() - since < seconds and not self.rospy.is_shutdown():
            if self.stage_state and self.stage_state.moving:
                since = time.monotonic()
            time.sleep(0.1)

    def stop_at(self, position):
        """Until the stage and the picture stand still there."""
        self.act('/camera/scan', 'Scan', self.msg.ScanGoal(positions=[position]), 30.0)

    def scan(self, positions):
        """Stops at each position until a cloud taken there has come. The first ones have no baseline yet."""
        for index, position in enumerate(positions):
            self.stop_at(position)
            arrived = self.rospy.Time.now().to_sec()
            if index >= 2:
                self.clock.wait('a cloud at %.1f m' % position,
                                lambda: self.cloud_stamp > arrived, 30.0)
            self.clock.say('scan: stage at %.1f m, %d clouds so far' % (position, self.clouds))


def free_port():
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


def master_port(headless):
    """The usual one where people look on, so that `./run exec …` in another shell finds the rig."""
    with socket.socket() as probe:
        taken = probe.connect_ex(('127.0.0.1', USUAL_PORT)) == 0
    return free_port() if headless or taken else USUAL_PORT


def start_screen(processes, clock):
    """A virtual screen on a display number of its own choice."""
    receive, send = os.pipe()
    try:
        process = processes.start('xvfb', ['Xvfb', '-displayfd', str(send), '-screen', '0',
                                           '1280x1024x24', '-nolisten', 'tcp'], pass_fds=[send])
    finally:
        os.close(send)
    os.set_blocking(receive, False)
    number = b''

    def ready():
        nonlocal number
        if process.poll() is not None:
            raise Failure('the virtual screen (Xvfb) did not start')
        try:
            number += os.read(receive, 64)
        except BlockingIOError:
            pass
        return number.endswith(b'\n')

    try:
        clock.wait('the start of the virtual screen', ready, 20.0)
    finally:
        os.close(receive)
    return ':' + number.decode().strip()


def colours_in(picture):
    """How many colours the part of the picture has where rviz draws the scene."""
    done = subprocess.run(['convert', str(picture), '-crop', '900x480+330+100', '-format', '%k', 'info:'],
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    return int(done.stdout) if done.returncode == 0 and done.stdout.isdigit() else 0


def take_picture(display, path):
    # Ten thousand colours are far more than frames and labels have, and far fewer than a cloud.
    for _ in range(5):
        time.sleep(3.0)
        done = subprocess.run(['import', '-display', display, '-window', 'root', str(path)],
                              stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                              stderr=subprocess.DEVNULL)
        if done.returncode == 0 and colours_in(path) > 10000:
            return
    raise Failure('rviz drew no cloud')


def check_bag(path):
    import rosbag
    try:
        with rosbag.Bag(str(path)) as bag:
            topics = bag.get_type_and_topic_info().topics
    except (rosbag.ROSBagException, OSError) as error:
        raise Failure('the bag cannot be read: %s' % error)
    for topic in ('/camera/image_raw', '/camera/lens_model', '/camera/points2', '/camera/stage_frames', '/tf'):
        if topic not in topics:
            raise Failure('the bag holds no %s' % topic)
    return topics


def conduct(options, clock, processes, work):
    def watch(line):
        # What the nodes warn of belongs on the console, whatever else they say to the log.
        if any(word in line for word in ('[ WARN]', '[ERROR]', '[FATAL]', 'Traceback')) or \
                ('process has died' in line):
            print(line, flush=True)

    display = start_screen(processes, clock) if options.headless else None
    if display:
        os.environ['DISPLAY'] = display
    port = master_port(options.headless)
    os.environ['ROS_MASTER_URI'] = 'http://127.0.0.1:%d/' % port
    if port != USUAL_PORT and not options.headless:
        clock.say('port %d has a master already: type "export ROS_MASTER_URI=%s" in shells that shall see this rig' %
                  (USUAL_PORT, os.environ['ROS_MASTER_URI']))
    clock.say('starting the rig: simulated camera and stage, calibration, stereo')
    launch = processes.start(
        'roslaunch',
        ['roslaunch', '--skip-log-check', '-p', str(port), 'omnister', 'demo.launch',
         'gui:=%s' % str(not options.headless).lower(), 'store:=%s' % work,
         'cloud:=%s' % (work / 'cloud.ply'), 'range:=%s' % (work / 'range.tiff'),
         'port:=%s' % (work / 'stage')], watch)

    def master_is_up():
        if launch.poll() is not None:
            raise Failure('roslaunch ended: see %s' % (processes.log_folder / 'roslaunch.log'))
        with socket.socket() as probe:
            return probe.connect_ex(('127.0.0.1', port)) == 0

    clock.wait('the start of the ROS master', master_is_up, 30.0)
    rig = Rig(clock)
    image = rig.first_image()
    clock.say('camera: %d x %d images' % (image.width, image.height))
    if options.headless:
        processes.start('rosbag', ['rosbag', 'record', '--lz4', '-O', str(work / 'run.bag')] + RECORDED)
    rig.home()
    clock.say('stage: homed')
    lens_file = rig.calibrate()

    rviz = ['rviz', '-d', str(Path(package_folder()) / 'config' / 'demo.rviz')]
    if options.headless:
        processes.start('rviz', rviz)
    rig.watch_clouds()
    rig.scan(POSITIONS)
    if not options.headless:
        clock.say('the rig goes on scanning: close rviz or press Ctrl-C to end')
        failures = 0
        while launch.poll() is None:
            try:
                rig.scan(POSITIONS[::-1])
                rig.scan(POSITIONS)
                failures = 0
            except Failure as failure:
                if launch.poll() is not None:
                    break
                # Who drags the handle in rviz takes the stage away from the scan.
                failures += 1
                if failures == 3:
                    raise
                clock.say('%s; the scan goes on when the stage has rested for %.0f s' % (failure, REST))
                rig.wait_for_rest(REST)
        return
    shutil.copyfile(lens_file, work / 'lens.yaml')
    clock.say('saving: ' + rig.call('/camera/snapshot/save', rig.Trigger))
    processes.stop('rosbag')
    if processes.ended('rviz'):
        # Now and then Debian's aborts at a lock of its own as it starts.
        clock.say('rviz ended: it is started once more, for another scan')
        processes.stop('rviz')
        processes.start('rviz', rviz)
        rig.scan(POSITIONS[::-1])
    clock.say('taking the picture')
    take_picture(display, work / 'cloud.png')
    processes.stop('rviz', 5.0)
    topics = check_bag(work / 'run.bag')
    clock.say('bag: %d images, %d clouds' % (topics['/camera/image_raw'].message_count,
                                             topics['/camera/points2'].message_count))
    rig.rospy.signal_shutdown('done')


def package_folder():
    import rospkg
    return rospkg.RosPack().get_path('omnister')


def keep(work, out):
    missing = [name for name in ARTEFACTS
               if not (work / name).is_file() or (work / name).stat().st_size == 0]
    if missing:
        raise Failure('missing: ' + ', '.join(missing))
    for name in ARTEFACTS:
        os.replace(work / name, out / name)


def prepare_environment(work, headless):
    """A loopback master, and nothing that needs a name server, a home or a session."""
    for name in ('ROS_HOSTNAME', 'ROS_NAMESPACE'):
        os.environ.pop(name, None)
    os.environ['ROS_IP'] = '127.0.0.1'
    os.environ['ROS_HOME'] = str(work / 'ros')
    os.environ['ROS_LOG_DIR'] = str(work / 'ros' / 'log')
    os.environ.setdefault('LC_ALL', 'C.UTF-8')
    if headless:
        runtime = work / 'runtime'
        runtime.mkdir(mode=0o700)
        os.environ.update(HOME=str(work), XDG_RUNTIME_DIR=str(runtime), LIBGL_ALWAYS_SOFTWARE='1',
                          QT_QPA_PLATFORM='xcb')
        os.environ.pop('XAUTHORITY', None)


def main():
    parser = argparse.ArgumentParser(prog='run demo', description=__doc__)
    parser.add_argument('--headless', action='store_true',
                        help='without a screen; ends by itself and leaves its results in --out')
    parser.add_argument('--out', metavar='DIR', type=Path,
                        help='folder for %s' % ', '.join(ARTEFACTS))
    options = parser.parse_args()
    if options.headless != (options.out is not None):
        parser.error('--headless and --out belong together')
    if not options.headless and not os.environ.get('DISPLAY'):
        parser.error('there is no screen (DISPLAY is not set): use --headless --out DIR')

    def on_signal(number, _):
        raise KeyboardInterrupt if number == signal.SIGINT else Failure(signal.Signals(number).name)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM):
        signal.signal(number, on_signal)
    clock = Clock(HEADLESS_SECONDS if options.headless else None)
    processes = None
    work = None
    try:
        if options.headless:
            options.out = options.out.absolute()
            options.out.mkdir(parents=True, exist_ok=True)
            signal.alarm(int(HEADLESS_SECONDS) + 3)
        # Beside the results, so that moving them there is atomic.
        work = Path(tempfile.mkdtemp(prefix='.demo-', dir=options.out))
        logs = options.out / 'log' if options.headless else work
        logs.mkdir(exist_ok=True)
        processes = Processes(logs)
        prepare_environment(work, options.headless)
        conduct(options, clock, processes, work)
        processes.stop_all()
        if options.headless:
            keep(work, options.out)
            clock.say('done: %s' % ', '.join(str(options.out / name) for name in ARTEFACTS))
        return 0
    except KeyboardInterrupt:
        clock.say('stopped')
        return 130 if options.headless else 0
    except (Failure, OSError) as error:
        print('demo: %s' % error, file=sys.stderr, flush=True)
        return 1
    finally:
        signal.alarm(0)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        if processes:
            processes.stop_all()
        if work:
            shutil.rmtree(work, ignore_errors=True)


if __name__ == '__main__':
    sys.exit(main())
