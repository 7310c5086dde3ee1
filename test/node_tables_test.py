#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Holds docs/nodes.md and the launch files to the code: every parameter, topic and service that a node has stands in its
table, the tables name none that it has not, defaults and ranges that are numbers in both are equal, what changes live is
a parameter, and every argument of a launch file is described. Usage: node_tables_test.py SOURCE"""
import re
import sys
import xml.etree.ElementTree
from pathlib import Path

# By the first word of a section: where its parameters are read, and where its topics and services are made.
SECTIONS = {
    'Camera': ['camera_driver'],
    'Stage': ['stage_driver', 'external_stage'],
    'Handle': ['stage_marker'],
    'Scan': ['scan_server'],
    'Simulated': ['sim_rig'],
    '`stereo_node`': ['stereo_parameters', 'stereo_pipeline', 'drift_diagnostic'],
    '`view_node`': ['view_server'],
    '`calibration_node`': ['calibration_server'],
    '`snapshot_node`': ['snapshot_server'],
}
LIVE = {'Camera': 'Camera', '`stereo_node`': 'Stereo', '`view_node`': 'View'}
GETTER = re.compile(r'\b(?:source|parameters)\.(text|choice|number|integer|flag|frame|direction|pose|texts)\(\s*"(\w+)"'
                    r'(?:,\s*([^,;]+?)(?:,\s*([^,;]+?),\s*([^,;)]+?))?\s*[,)])?', re.S)
# advertise, advertiseCamera, advertiseService and subscribe with a name that stands there.
TOPIC = re.compile(r'\b(?:advertise|subscribe)\w*(?:<[\w:, ]+>)?\(\s*"([\w/]+)"', re.S)
CODE = re.compile(r'`([^`]+)`')


def sections(text):
    result, name = {}, None
    for line in text.splitlines():
        if line.startswith('## '):
            name = line[3:].split(':')[0].split(' ')[0].rstrip(',')
            result[name] = []
        elif name:
            result[name].append(line)
    return result


def tables(lines):
    """Header and rows of each table, cells stripped."""
    result = []
    for line in lines:
        if not line.startswith('|'):
            result.append(None)
            continue
        row = [cell.strip() for cell in line.strip('|').split('|')]
        if not result or result[-1] is None:
            result.append([])
        if not all(set(cell) <= set('-: ') for cell in row):
            result[-1].append(row)
    return [table for table in result if table]


def plain_number(text):
    """The number that a cell or an argument begins with, or None: 0.04 s, `custom`, required."""
    found = re.fullmatch(r'`?(-?[0-9][0-9.]*(?:e-?[0-9]+)?)(?![\w/])[^0-9]*', text.strip())
    return float(found.group(1)) if found else None


def compare_numbers(name, getter, headers, default, bounds, complain):
    kind, _, fallback, low, high = getter
    if kind not in ('number', 'integer'):
        return
    # A default that is a member stands in the header.
    member = re.search(r'\b%s = ([^;]+);' % re.escape(fallback.split('.')[-1]), headers)
    expected, told = plain_number(member.group(1) if member else fallback), plain_number(default)
    if expected is not None and told is not None and expected != told:
        complain('default of `%s` is %g in the table, %g in the code' % (name, told, expected))
    found = re.fullmatch(r'(-?[0-9.e-]+) to (-?[0-9.e]+)(?: [a-zA-Z]+)?', bounds.strip())
    limits = [plain_number(limit or '') for limit in (low, high)]
    if found and None not in limits and [float(g) for g in found.groups()] != limits:
        complain('range of `%s` is %s in the table, %g to %g in the code' % (name, bounds.strip(), *limits))


def one_file(source, name):
    """Text of the file of that name below src/ros."""
    files = list(source.glob('src/ros/**/' + name))
    if len(files) != 1:
        sys.exit('%d files below src/ros are called %s: does this test still read them?' % (len(files), name))
    return files[0].read_text()


def check_section(name, lines, source, complain):
    code = ''.join(one_file(source, unit + '.cpp') for unit in SECTIONS[name])
    headers = ''.join(one_file(source, unit + '.h') for unit in SECTIONS[name])
    getters = {getter[1]: getter for getter in GETTER.findall(code)}
    if not getters:
        complain('no parameter was found in the code: does this test still read it?')
    named, topics = set(), set()
    for table in tables(lines):
        header = table[0]
        for row in table[1:]:
            names = CODE.findall(row[0])
            if header[0] != 'parameter':
                topics.update(names)
                continue
            named.update(names)
            defaults = row[1].split(', ')
            for index, parameter in enumerate(names):
                if parameter not in getters or row[1] == '':
                    continue
                at = lambda cells: cells[index] if len(cells) == len(names) else cells[0] if len(cells) == 1 else ''
                compare_numbers(parameter, getters[parameter], headers, at(defaults), at(re.split(r'[,;] ', row[2])),
                                complain)
    for parameter in sorted(set(getters) - named):
        complain('parameter `%s` is in no table' % parameter)
    for parameter in sorted(named):
        if '"%s"' % parameter not in code:
            complain('the table has a parameter `%s` that the code does not read' % parameter)
    text = '\n'.join(lines)
    known = topics | set(CODE.findall(text))
    for topic in sorted(set(TOPIC.findall(code))):
        # Of an action, `calibrate/goal` is the topic and `calibrate` the name.
        if not {topic, '~' + topic, topic.rsplit('/goal', 1)[0]} & known:
            complain('topic or service `%s` is not named' % topic)
    return code


def main():
    source = Path(sys.argv[1])
    failures = []
    found = sections((source / 'docs/nodes.md').read_text())
    for name in SECTIONS:
        complain = lambda what, name=name: failures.append('docs/nodes.md, %s: %s' % (name, what))
        if name not in found:
            complain('there is no such section')
            continue
        code = check_section(name, found[name], source, complain)
        if name in LIVE:
            live = re.findall(r"gen\.add\('(\w+)'", (source / 'cfg' / (LIVE[name] + '.cfg')).read_text())
            for parameter in live:
                if '"%s"' % parameter not in code:
                    complain('%s.cfg has `%s`, which is no parameter' % (LIVE[name], parameter))
    arguments = 0
    for launch in sorted((source / 'launch').glob('*.launch')):
        for arg in xml.etree.ElementTree.parse(launch).getroot().findall('arg'):
            arguments += 1
            if 'value' not in arg.attrib and not arg.attrib.get('doc', '').strip():
                failures.append('%s: arg %s has no doc' % (launch.name, arg.attrib['name']))
    if arguments < 100:
        failures.append('%d arguments of launch files were found: does this test still read them?' % arguments)
    print('\n'.join(failures) or 'ok: %d sections, %d launch arguments' % (len(SECTIONS), arguments))
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
