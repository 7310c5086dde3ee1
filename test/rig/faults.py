#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Breaks the simulated rig in every way it knows, and measures: what the user sees and when, how soon all is well
after the end of the fault, what was lost. Writes a table.

    ./run faults [--quick] [--only WORD] [--table FILE.md] [--json FILE]

Exit status 0 when each fault is noticed within 2 s and over within 5 s of its end; 77 where a network of its own
cannot be had."""
import argparse
import concurrent.futures
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import threading
import time

import lab

NOTICED_WITHIN, RECOVERED_WITHIN = 2.0, 5.0  # [s]
PATIENCE = 60.0                              # until something is said never to come [s]
HOLD = 4.0                                   # a fault lasts at least so long [s]
WARNING = re.compile(r'\[ ?(WARN|ERROR|FATAL)\].*?: (.*)|(process has died)')
COLOURS = re.compile(r'\x1b\[[0-9;]*m')


SILENT = 'no frame|no image|no camera'
NO_STAGE = 'no stage|link lost'


class Fault:
    """One row of the table."""
    sign = None          # what is said of this fault and not of others
    begins_late = False  # only with the end of what begins it
    quick = False
    passing = False      # nothing needs to be said: the rig copes
    stream = None        # of a fault without an end: the topic that stays away
    begin_words = end_words = None

    def __init__(self, name, begin, end, recovered=None, **more):
        self.name, self.begin_words, self.end_words = name, begin, end
        self.recovered_by = recovered
        for key, value in more.items():
            assert hasattr(self, key), key
            setattr(self, key, value)

    @staticmethod
    def do(rig, action):
        if callable(action):
            action(rig)
        elif action:
            rig.fault(action)

    def recovered(self, rig, since):
        if self.recovered_by:
            return self.recovered_by(rig, since)
        return fresh_cloud(rig, since)


def fresh_cloud(rig, since):
    """A cloud of an image that was taken after this."""
    return any(when - age > since and age < 2.0 for when, age in rig.watcher.ages[-20:])


def usable(rig, since):
    state = rig.watcher.stage
    return rig.watcher.seen.get('stage', 0.0) > since and state.fault == '' and (state.homed or state.moving)


class Pressure:
    """Other programs that want the processor."""

    def __init__(self):
        self.programs = []

    def begin(self, _):
        self.programs = [subprocess.Popen([sys.executable, '-c', 'while True: pass'])
                         for _ in range(4 * os.cpu_count())]

    def end(self, _):
        for program in self.programs:
            program.kill()
            program.wait()


class FalseTransforms:
    """Somebody else who tells tf where the carriage is."""

    def __init__(self, ahead, jump):
        self.ahead, self.jump = ahead, jump
        self.stop = threading.Event()

    def begin(self, rig):
        from geometry_msgs.msg import TransformStamped
        from tf2_msgs.msg import TFMessage
        publisher = rig.rospy.Publisher('/tf', TFMessage, queue_size=10)

        def run():
            while not self.stop.is_set():
                transform = TransformStamped()
                transform.header.stamp = rig.rospy.Time.now() + rig.rospy.Duration(self.ahead)
                transform.header.frame_id, transform.child_frame_id = 'stage_base', 'stage_carriage'
                transform.transform.translation.y = random.uniform(-self.jump, self.jump)
                transform.transform.rotation.w = 1.0
                publisher.publish(TFMessage([transform]))
                self.stop.wait(0.02)
            publisher.unregister()

        threading.Thread(target=run, daemon=True).start()

    def end(self, _):
        self.stop.set()


class Memory:
    """What a process may have, from now on: what it has and next to nothing more."""

    def __init__(self, node):
        self.node = node
        self.pid = None

    def begin(self, rig):
        self.pid = rig.pid(self.node)
        size = int(re.search(r'VmSize:\s+(\d+)', open('/proc/%d/status' % self.pid).read()).group(1)) * 1024
        resource.prlimit(self.pid, resource.RLIMIT_AS, (size + (1 << 20), resource.RLIM_INFINITY))

    def end(self, _):
        if lab.resources(self.pid):
            resource.prlimit(self.pid, resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


class Signals:
    """To the process of a node."""

    def __init__(self, node, begin, end=None):
        self.node, self.first, self.last = node, begin, end
        self.pid = None

    def begin(self, rig):
        self.pid = rig.pid(self.node)
        os.kill(self.pid, self.first)

    def end(self, _):
        if self.last:
            os.kill(self.pid, self.last)


def recover_stage(rig):
    rig.rig.call('/stage/recover', rig.rig.Trigger)
    rig.rig.call('/stage/home', rig.rig.Trigger)


def home_stage(rig):
    rig.rig.call('/stage/home', rig.rig.Trigger)


def restart_master(rig):
    rig.processes.stop('rosmaster')
    time.sleep(0.5)
    rig.start_master()


class CarriageHangs:
    """The stage says that it is where the carriage is not: from the end of its next motion on."""

    def begin(self, rig):
        rig.fault('stage slip')
        # A motion that is about to end truly took place.
        for moving in (False, True, False):
            rig.clock.wait('a motion of the stage', lambda: bool(rig.watcher.stage.moving) == moving, 60.0)

    def end(self, rig):
        rig.fault('stage grip')


class ClockStep:
    """Somebody sets the clock of the machine, and later sets it right."""

    def __init__(self, ahead):
        self.ahead = ahead

    def begin(self, rig):
        rig.machine_clock.set(self.ahead)

    def end(self, rig):
        rig.machine_clock.set(0)


def all_faults():
    """Those of one rig, and those of one whose clock can be set."""
    load, jumps, future = Pressure(), FalseTransforms(0.0, 0.3), FalseTransforms(60.0, 0.0)
    driver = Signals('/stage/driver', signal.SIGSTOP, signal.SIGCONT)
    killed, manager = Signals('/stage/driver', signal.SIGKILL), Signals('/manager', signal.SIGKILL)
    memory, hangs = Memory('/manager'), CarriageHangs()
    ahead, back = ClockStep(30), ClockStep(-30)
    of_the_clock = [
        Fault('clock of the machine set 30 s ahead, and right again', ahead.begin, ahead.end, sign='clock|jump'),
        Fault('clock of the machine set 30 s back, and right again', back.begin, back.end, sign='clock|jump'),
    ]
    of_the_rig = [
        Fault('camera loses its power', 'camera off', 'camera on', sign=SILENT, quick=True),
        Fault('camera answers and gives no frames', 'camera freeze', 'camera thaw', sign=SILENT),
        # The camera sends them again.
        Fault('a fifth of the packets is lost', 'camera loss 0.2', 'camera loss 0', sign=SILENT + '|incomplete|lost',
              passing=True),
        Fault('nine of ten packets are lost', 'camera loss 0.9', 'camera loss 0', sign=SILENT + '|incomplete|lost'),
        Fault('camera changes its region in flight', 'camera size 200 150', 'camera size 400 300', sign='200x150'),
        Fault('stage stalls', 'stage stall', recover_stage, usable, sign='stall'),
        Fault('cable of the stage unplugged', 'stage unplug', 'stage plug', usable_again, sign=NO_STAGE, quick=True),
        Fault('stage loses its power for a moment', 'stage reset', home_stage, usable, sign='not homed|reference'),
        Fault('stage answers nothing', 'stage freeze', 'stage thaw', usable_again, sign=NO_STAGE + '|no pose'),
        Fault('a tenth of the serial lines is garbled', 'stage garble 0.1', 'stage garble 0', sign='stage', passing=True),
        Fault('carriage does not follow, the stage says it does', hangs.begin, hangs.end, sign='parallax|empty',
              begins_late=True),
        Fault('tf missing (stage driver stopped)', driver.begin, driver.end, sign='no pose|tf does not', quick=True),
        Fault('tf jumps (a second publisher)', jumps.begin, jumps.end, sign='jumps'),
        Fault('tf from the future (60 s ahead)', future.begin, future.end, sign='no pose|ahead|tf does not'),
        Fault('stage driver killed', killed.begin, None, stream='stage', sign='has died'),
        Fault('nodelet manager killed', manager.begin, None, stream=lab.VIEWS, sign='has died|is gone', quick=True),
        Fault('processor starved (%d busy programs)' % (4 * os.cpu_count()), load.begin, load.end,
              sign=SILENT + '|lost', passing=True),
        Fault('memory of the nodelet manager limited to what it has', memory.begin, memory.end,
              sign='bad_alloc|memory|has died|is gone', passing=True),
        # Last: who was there before is not known to the new master.
        Fault('ROS master restarted', restart_master, None, stream=lab.VIEWS, sign='master'),
    ]
    return of_the_rig, of_the_clock


def usable_again(rig, since):
    """It answers again; whether it kept its reference is its own affair."""
    return rig.watcher.seen.get('stage', 0.0) > since and rig.watcher.stage.fault == ''


class Trial:
    """One fault on a rig that is well."""

    def __init__(self, rig, fault):
        self.rig, self.fault, self.watcher = rig, fault, rig.watcher
        self.began = time.monotonic()
        self.counts = self.counters()

    def counters(self):
        found = {}
        for name, key, said in (('camera', 'frames lost', 'frames of the camera'),
                                ('camera', 'frames incomplete', 'frames torn'),
                                ('stereo', 'dropped, missed', 'images missed by the matcher'),
                                ('stereo', 'dropped, bad image', 'images refused'),
                                ('stereo', 'frames, no pose', 'images without a pose'),
                                ('stereo', 'dropped, failed', 'sets that could not be matched')):
            found[said] = self.watcher.number(name, key)
        return found

    def is_sign(self, text):
        return re.search(self.fault.sign, text) is not None

    def notice(self):
        """What came first of all that a user sees. @return (seconds, text) or None"""
        first = None
        for when, name, level, message in list(self.watcher.history):
            if when > self.began and level > 0 and self.is_sign(message) and (first is None or when < first[0]):
                first = when, 'diagnostic %s: %s' % (name, message)
        for when, line in list(self.rig.output):
            found = WARNING.search(COLOURS.sub('', line))
            if found and when > self.began and 'fault: ' not in line and self.is_sign(line) and \
                    (first is None or when < first[0]):
                first = when, found.group(2) or COLOURS.sub('', line)
        return (first[0] - self.began, first[1]) if first else None

    def wait(self, condition, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            value = condition()
            if value:
                return value
            time.sleep(0.01)
        return condition()

    def run(self):
        fault = self.fault
        self.began = time.monotonic()
        fault.do(self.rig, fault.begin_words)
        if fault.begins_late:
            self.began = time.monotonic()
        noticed = self.wait(self.notice, HOLD if fault.passing else PATIENCE)
        time.sleep(max(0.0, HOLD - (time.monotonic() - self.began)))
        ended = time.monotonic() if fault.end_words else self.began
        fault.do(self.rig, fault.end_words)
        if fault.stream:
            # It has no end: how long did what it gives stay away?
            self.wait(lambda: self.watcher.seen.get(fault.stream, 0.0) > ended + HOLD, PATIENCE)
            over = self.watcher.seen.get(fault.stream, 0.0) > ended + HOLD
            recovered = self.watcher.longest_gap(fault.stream, ended) if over else None
        else:
            over = self.wait(lambda: fault.recovered(self.rig, ended), PATIENCE)
            recovered = time.monotonic() - ended if over else None
        time.sleep(2.1)
        lost = {name: int(count - self.counts[name]) for name, count in self.counters().items()
                if count > self.counts[name]}
        return {'fault': fault.name, 'noticed_s': noticed and noticed[0], 'seen': noticed and noticed[1],
                'recovered_s': recovered, 'lost': lost, 'passing': fault.passing}


def holds(row, patient):
    def within(value, bound):
        return value is not None and (patient or value <= bound)

    return (row['passing'] or within(row['noticed_s'], NOTICED_WITHIN)) and within(row['recovered_s'], RECOVERED_WITHIN)


def seconds(value):
    return 'never' if value is None else '%.1f s' % value


def table(rows):
    lines = ['| fault | what the user sees first | noticed after | well again after its end | lost |',
             '| --- | --- | --- | --- | --- |']
    for row in rows:
        lost = ', '.join('%d %s' % (count, name) for name, count in row['lost'].items()) or 'nothing'
        seen = row['seen'] or 'nothing: it goes on'
        seen = re.sub(r'[0-9.]{12,}|/tmp/\S+/', '…', re.sub(r' \[pid .*', '', seen)).replace('|', '/')
        noticed = '-' if row['passing'] and row['noticed_s'] is None else seconds(row['noticed_s'])
        lines.append('| %s | %s | %s | %s | %s |' % (row['fault'], seen[:120], noticed, seconds(row['recovered_s']), lost))
    return '\n'.join(lines) + '\n'


def replace_table(path, text):
    """The table is the last thing in the document."""
    before = ''
    if os.path.exists(path):
        with open(path) as file:
            before = file.read().split('| fault |')[0]
    with open(path, 'w') as file:
        file.write(before + text)


class Slider(threading.Thread):
    """The stage goes to and fro whatever happens."""

    def __init__(self, rig):
        super().__init__(daemon=True)
        self.rig = rig
        self.stop = threading.Event()

    def run(self):
        while not self.stop.is_set():
            try:
                self.rig.slide(5.0)
            except (lab.demo.Failure, self.rig.rospy.ROSException):
                time.sleep(0.2)


def heal(rig):
    """Before the next fault: homed, and clouds that come without a complaint."""
    state = rig.watcher.stage
    if not state.homed and not state.moving:
        recover_stage(rig)
    since = time.monotonic()
    rig.clock.wait('a healthy rig', lambda: fresh_cloud(rig, since) and rig.watcher.stage.homed and
                   not any(rig.watcher.levels.get(name) for name in ('camera', 'stage', 'stereo')), 120.0)


def chosen(options):
    """Of each kind of rig."""
    return [[fault for fault in faults if (fault.quick or not options.quick) and
             (not options.only or options.only in fault.name)] for faults in all_faults()]


def try_all(kind, options):
    """On one rig, one after the other. @return rows of the table"""
    rows = []
    try:
        with lab.Lab(options.log, own_clock=kind > 0) as rig:
            slider = Slider(rig)
            slider.start()
            for fault in chosen(options)[kind]:
                heal(rig)
                row = Trial(rig, fault).run()
                rows.append(row)
                print('%s  %-50s noticed %s, well again %s  %s' % (
                    'ok  ' if holds(row, options.patient) else 'FAIL', row['fault'], seconds(row['noticed_s']),
                    seconds(row['recovered_s']), row['seen']), flush=True)
            slider.stop.set()
    except lab.demo.Failure as failure:
        print('faults: %s' % failure, file=sys.stderr)
        rows.append({'fault': 'the run: %s' % failure, 'noticed_s': None, 'seen': None, 'recovered_s': None, 'lost': {},
                     'passing': False})
    return rows


def main():
    parser = argparse.ArgumentParser(prog='run faults', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--quick', action='store_true', help='a few of them, within a minute')
    parser.add_argument('--patient', action='store_true', help='asks no speed of the machine: noticed and over at all')
    parser.add_argument('--only', metavar='WORD', help='those whose name holds it')
    parser.add_argument('--table', metavar='FILE', help='the table, as Markdown')
    parser.add_argument('--json', metavar='FILE')
    parser.add_argument('--log', metavar='DIR', help='what the nodes say goes there')
    options = parser.parse_args()
    lab.own_network()
    rows = []
    for kind, faults in enumerate(chosen(options)):
        if kind > 0 and faults and not lab.MachineClock.library():
            print('skipped: the clock cannot be set without libfaketime', file=sys.stderr)
        elif faults:
            # A program is of one master only.
            with concurrent.futures.ProcessPoolExecutor(1) as another:
                rows += another.submit(try_all, kind, options).result()
    text = table(rows)
    print(text)
    if options.table:
        replace_table(options.table, text)
    if options.json:
        with open(options.json, 'w') as file:
            json.dump({'rows': rows, 'load': os.getloadavg()[0]}, file, indent=1)
    return 0 if rows and all(holds(row, options.patient) for row in rows) else 1


if __name__ == '__main__':
    sys.exit(main())
