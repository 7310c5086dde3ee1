#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""The simulated rig for long: camera, stereo and view in one nodelet manager, the stage going to and fro. Memory
stays, files stay, latency stays, and every image is accounted for.

    ./run soak MINUTES [--json FILE]

Exit status 0 when all bounds hold; 77 where a network of its own cannot be had."""
import argparse
import json
import os
import statistics
import sys
import threading
import time

import lab

WARM_UP_SHARE, WARM_UP_MOST = 0.25, 180.0  # of the run; [s]
MEMORY_BOUND = 1.0                         # [MB] a minute
SAMPLE_PERIOD = 1.0                        # [s]
LONG = 600.0                               # [s]
IN_FLIGHT = 3                              # images between two counters of one node


class Bounds:
    def __init__(self):
        self.lines = []

    def check(self, holds, name, figure):
        self.lines.append({'bound': name, 'holds': bool(holds), 'figure': figure})
        print('%s  %-46s %s' % ('ok  ' if holds else 'FAIL', name, figure), flush=True)

    def hold(self):
        return all(line['holds'] for line in self.lines)


def growth(samples):
    """[1/min]: slope through the middles of the first and the last third, which single peaks do not move."""
    third = len(samples) // 3
    first, last = samples[:third], samples[-third:]
    minutes = (statistics.median(t for t, _ in last) - statistics.median(t for t, _ in first)) / 60.0
    return (statistics.median(v for _, v in last) - statistics.median(v for _, v in first)) / minutes


def stereo_balance(values):
    """Images that came in, without those that are known to have gone out or to be on their way."""
    def number(key):
        return int(float(values.get(key, '0')))

    def total(start, *but):
        return sum(int(float(value)) for key, value in values.items()
                   if key.startswith(start) and key[len(start):] not in but)

    received = number('images of /camera/image_raw')
    images = received - number('dropped, bad image') - total('frames, ', 'received', 'resets', 'settled', 'paired',
                                                               'superseded', 'no baseline') - number('frames, settled')
    settled = number('frames, settled') - number('frames, no baseline') - number('frames, paired')
    sets = number('frames, paired') - number('frames, superseded') - number('clouds') - \
        number('sets, waiting or matched') - total('dropped, ', 'bad image', 'bad lens', 'missed')
    return images, settled, sets


class Soak:
    def __init__(self, rig, patient):
        self.rig = rig
        self.patient = patient
        self.watcher = rig.watcher
        self.resources = {}  # node: [(time, megabytes, files, threads)]
        self.unbalanced = []
        self.failed_moves = 0
        self.moves = 0
        self.stop = threading.Event()
        self.watcher.checks.append(self.check_balance)

    def check_balance(self, name, values):
        if name != 'stereo':
            return
        balance = stereo_balance(values)
        if any(abs(part) > IN_FLIGHT for part in balance):
            self.unbalanced.append(balance)

    def slide(self):
        while not self.stop.is_set():
            try:
                self.rig.slide()
                self.moves += 1
            except lab.demo.Failure:
                self.failed_moves += not self.stop.is_set()

    def sample(self, pids):
        now = time.monotonic()
        for node, pid in pids.items():
            found = lab.resources(pid)
            if found:
                self.resources.setdefault(node, []).append((now,) + found)

    def run(self, seconds):
        pids = {node: self.rig.pid(node) for node in lab.NODES}
        mover = threading.Thread(target=self.slide, daemon=True)
        mover.start()
        began = time.monotonic()
        while time.monotonic() < began + seconds:
            self.sample(pids)
            time.sleep(SAMPLE_PERIOD)
        self.stop.set()
        mover.join(60.0)
        self.warm = began + min(WARM_UP_SHARE * seconds, WARM_UP_MOST)
        return {node: self.rig.pid(node) for node in lab.NODES} == pids

    def judge(self, bounds):
        for node in lab.NODES:
            samples = [s for s in self.resources.get(node, []) if s[0] >= self.warm]
            if len(samples) < 9:
                bounds.check(False, '%s runs' % node, 'no samples')
                continue
            slope = growth([(s[0], s[1]) for s in samples])
            bounds.check(slope <= MEMORY_BOUND, '%s: memory [MB/min]' % node,
                         '%+.3f (%.1f to %.1f MB)' % (slope, samples[0][1], samples[-1][1]))
            third = len(samples) // 3
            # The pool for parallel loops begins its threads, one a core at the most, when work calls for them; in a
            # third of a long run it did.
            pool = os.cpu_count() if samples[-1][0] - samples[0][0] < LONG else 0
            # Connections of who moves the stage and of the doctor come and go: what stays is the least.
            for index, name, least, more in ((2, 'files', min, 0), (3, 'threads', statistics.median, pool)):
                first = least(s[index] for s in samples[:third])
                last = least(s[index] for s in samples[-third:])
                bounds.check(last <= first + more, '%s: %s' % (node, name), '%d, then %d' % (first, last))
        ages = [(t, age) for t, age in self.watcher.ages if t >= self.warm]
        third = len(ages) // 3
        if third:
            first = statistics.median(age for _, age in ages[:third])
            last = statistics.median(age for _, age in ages[-third:])
            # Twice and a little: the machine is not ours alone.
            bounds.check(self.patient or last <= 2.0 * first + 0.5, 'age of the images in clouds [s]', '%.3f, then %.3f' % (first, last))
        bounds.check(len(ages) >= 9, 'clouds after the warm-up', len(ages))
        bounds.check(self.failed_moves == 0, 'moves of the stage', '%d, %d failed' % (self.moves, self.failed_moves))

    def account(self, bounds):
        """The camera goes; when all that was on its way has arrived, every image must be found somewhere."""
        watcher = self.watcher
        self.rig.fault('camera off')

        def rests():
            counters = [dict(watcher.values[name]) for name in ('camera', 'stereo', 'view')]
            counts = dict(watcher.counts, stage=0)
            time.sleep(2.5)
            return counters[1:] == [watcher.values[name] for name in ('stereo', 'view')] and \
                counts == dict(watcher.counts, stage=0) and counters[0].get('state') == 'lost' and \
                watcher.number('stereo', 'frames, waiting') == 0 == watcher.number('stereo', 'sets, waiting or matched')

        self.rig.clock.wait('rest after the last image', rests, 90.0)
        number = watcher.number
        published, lost = number('camera', 'frames published'), number('camera', 'frames lost')
        received, missed = number('stereo', 'images of /camera/image_raw'), number('stereo', 'dropped, missed')
        bounds.check(published == received + missed, 'images of the camera, all at the matcher',
                     '%d published (%d lost on the wire), %d received, %d missed' % (published, lost, received, missed))
        balance = stereo_balance(watcher.values['stereo'])
        bounds.check(balance == (0, 0, 0) and not self.unbalanced, 'images at the matcher, each with its fate',
                     'left over %d, %d, %d; %d reports out of balance' % (balance + (len(self.unbalanced),)))
        clouds = number('stereo', 'clouds')
        came, late = watcher.counts['/camera/points2'], watcher.missed['/camera/points2']
        bounds.check(clouds == came + late, 'clouds, all at the listener',
                     '%d made, %d came, %d too fast for the listener' % (clouds, came, late))
        received, missed = number('view', 'images received'), number('view', 'images missed')
        done, failed = number('view', 'images published'), number('view', 'images failed')
        bounds.check(received == done + failed and failed == 0 and received + missed <= published,
                     'images at the view, each with its fate',
                     '%d received, %d missed, %d views, %d failed' % (received, missed, done, failed))
        came, late = watcher.counts[lab.VIEWS], watcher.missed[lab.VIEWS]
        bounds.check(done == came + late, 'views, all at the listener', '%d made, %d came, %d missed' % (done, came, late))
        for name in sorted(watcher.values['stereo']):
            if name.startswith(('frames, ', 'dropped, ')):
                print('        %-40s %s' % (name, watcher.values['stereo'][name]))


def main():
    parser = argparse.ArgumentParser(prog='run soak', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('minutes', type=float, help='from the first cloud on; at least 1')
    parser.add_argument('--json', metavar='FILE', help='the figures again')
    parser.add_argument('--patient', action='store_true', help='asks no speed of the machine')
    parser.add_argument('--frame-rate', type=float, default=5.0, help='of the camera [Hz]')
    parser.add_argument('--log', metavar='DIR', help='what the nodes say goes there')
    options = parser.parse_args()
    if not 1.0 <= options.minutes <= 100000.0:
        parser.error('MINUTES is %g, expected 1 to 100000' % options.minutes)
    lab.own_network()
    bounds = Bounds()
    try:
        with lab.Lab(options.log, frame_rate=options.frame_rate) as rig:
            soak = Soak(rig, options.patient)
            alive = soak.run(60.0 * options.minutes)
            bounds.check(alive, 'no process ended', ', '.join(lab.NODES))
            soak.judge(bounds)
            soak.account(bounds)
    except lab.demo.Failure as failure:
        bounds.check(False, 'the run', str(failure))
    if options.json:
        with open(options.json, 'w') as file:
            json.dump({'minutes': options.minutes, 'load': os.getloadavg()[0], 'bounds': bounds.lines}, file, indent=1)
    print('all bounds hold' if bounds.hold() else 'some bounds do not hold')
    return 0 if bounds.hold() else 1


if __name__ == '__main__':
    sys.exit(main())
