// SPDX-License-Identifier: Apache-2.0
#include "health/doctor.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "omnister/common/error.h"

namespace omnister {
namespace {

constexpr double kOldStamp = 5.0;            // [s] clocks that differ by more are not one clock
constexpr double kDark = 0.02;               // mean level of an image that shows nothing
constexpr double kSaturated = 0.5;           // share of pixels
constexpr double kFewValid = 0.02;           // share of a cloud's pixels
constexpr double kLossWorthATell = 0.005;    // share of frames
constexpr double kWorkingShare = 0.8;        // of a link that images can fill
constexpr double kEnoughSocketBuffer = 2e6;  // [bytes] as measured for 5-megapixel frames
constexpr double kHighBandwidth = 40e6;      // [bytes/s] above which small packets cost too much
constexpr double kBusyShare = 0.5;           // of the sets dropped because the matcher is busy
constexpr double kLittleMemory = 300.0;      // [MB]

using Severity = Finding::Severity;

std::string number(double value, const char* format = "%.3g") {
  char text[48];
  std::snprintf(text, sizeof text, format, value);
  return text;
}

double count(const std::map<std::string, double>& counts, const std::string& name) {
  const auto found = counts.find(name);
  return found == counts.end() ? 0.0 : found->second;
}

/// Collects findings; after an error, whatever else follows from it is not asked.
class Findings {
 public:
  void error(const std::string& code, const std::string& cause, const std::string& mend) {
    list_.push_back({code, Severity::kError, cause, mend});
  }
  void warning(const std::string& code, const std::string& cause, const std::string& mend) {
    list_.push_back({code, Severity::kWarning, cause, mend});
  }
  void note(const std::string& code, const std::string& cause, const std::string& mend) {
    list_.push_back({code, Severity::kNote, cause, mend});
  }
  bool failed() const {
    return std::any_of(list_.begin(), list_.end(),
                       [](const Finding& f) { return f.severity == Severity::kError; });
  }
  std::vector<Finding> take() { return std::move(list_); }

 private:
  std::vector<Finding> list_;
};

std::string bytesPerSecond(double value) { return number(value / 1e6, "%.0f") + " MB/s"; }

/// Bytes a pixel by encoding; Bayer and grey have one channel.
double bytesPerPixel(const std::string& encoding) {
  const bool sixteen = encoding.find("16") != std::string::npos;
  const bool color = encoding.find("bgr") == 0 || encoding.find("rgb") == 0;
  return (sixteen ? 2.0 : 1.0) * (color ? 3.0 : 1.0);
}

bool knownEncoding(const std::string& encoding) {
  for (const char* start : {"mono", "bgr", "rgb", "bayer_", "8UC", "16UC", "yuv"})
    if (encoding.find(start) == 0) return true;
  return false;
}

void machine(const DoctorFacts& facts, Findings& findings) {
  if (facts.sim_time && !facts.clock_published)
    findings.error("no_clock",
                   "/use_sim_time is set, but nobody publishes /clock: time stands still",
                   "rosparam set /use_sim_time false (and start the nodes anew), or play the "
                   "recording with --clock");
}

void camera(const DoctorFacts& facts, const DoctorFacts::Images& images, Findings& findings) {
  const std::string& topic = images.topic;
  if (images.publishers.empty())
    return findings.error(
        "no_camera", "nobody publishes " + topic,
        "roslaunch omnister camera.launch device:=… (or remap image_raw to your camera's topic)");
  if (!images.publisher_answers)
    return findings.error(
        "publisher_unreachable",
        "the node " + images.publishers.front() + " that publishes " + topic +
            " does not answer: it died, or its host name does not resolve here",
        "rosnode cleanup, then start it again; between machines set ROS_IP on each to an address "
        "that the other can reach");
  if (images.publishers.size() > 1)
    findings.error("two_publishers",
                   topic + " has " + std::to_string(images.publishers.size()) +
                       " publishers: " + images.publishers[0] + ", " + images.publishers[1],
                   "give each camera a namespace of its own (camera.launch camera:=NAME)");
  if (!images.received) return;
  if (*images.received == 0) {
    const std::string problem = printable(images.driver_problem, 300);
    const bool opening =
        images.driver && (images.driver_state == "opening" || images.driver_state == "lost");
    if (opening && problem.find("ermission") != std::string::npos)
      return findings.error("camera_permission",
                            images.driver_node + " may not open " + images.device + ": " + problem,
                            "sudo usermod -aG video $USER (V4L2) or install the udev rule of the "
                            "camera (USB3 Vision), then log in again");
    if (opening && (problem.find("ontroller privilege") != std::string::npos ||
                    problem.find("another program") != std::string::npos ||
                    problem.find("busy") != std::string::npos))
      return findings.error("camera_busy",
                            "another program controls " + images.device + ": " + problem,
                            "close it (a viewer, a second driver), or choose another camera");
    if (opening)
      return findings.error(
          "camera_absent",
          images.driver_node + " has no camera at " + images.device +
              (problem.empty() ? "" : ": " + problem),
          "check power and cable, then what is there: arv-tool-0.8 (GigE, USB3), v4l2-ctl "
          "--list-devices; set ~device to it");
    if (images.trigger != "off")
      return findings.error("camera_waits_for_trigger",
                            "the camera waits for its trigger (" + images.trigger +
                                "), and no image comes on " + topic,
                            "start the trigger, or rosparam set " + images.driver_node +
                                "/trigger off and start the camera again");
    return findings.error(
        "no_images",
        images.publishers.front() + " publishes no image on " + topic +
            (problem.empty() ? "" : ": " + problem),
        "rostopic hz " + topic + "; look at the camera's /diagnostics and its log");
  }
  if (!images.stamped)
    findings.error("no_stamp", "images on " + topic + " have no time stamp",
                   "have the driver stamp them: frames pair by the time of exposure");
  else if (std::abs(images.age) > kOldStamp)
    findings.error("clocks_differ",
                   "images on " + topic + " are stamped " + number(std::abs(images.age)) + " s " +
                       (images.age > 0 ? "before" : "after") + " now",
                   "bring the clocks together (chrony, PTP), or play recordings with --clock and "
                   "/use_sim_time true");
  if (images.frame_id.empty())
    findings.error("no_frame_id", "images on " + topic + " have no frame_id",
                   "set the driver's frame_id to the camera's optical frame");
  if (!knownEncoding(images.encoding))
    findings.error("bad_encoding",
                   "images on " + topic + " are '" + printable(images.encoding, 40) +
                       "', not 8 or 16 bit grey, colour or Bayer",
                   "choose another pixel_format in the driver");
  if (!images.lens && !images.lens_published)
    findings.error("no_lens", "the lens of " + topic + " is not known: no lens_model, no ~lens",
                   "roslaunch omnister calibrate.launch target:=TARGET.yaml, or stereo.launch "
                   "lens:=LENS.yaml");
  else if (!images.lens)
    findings.error("lens_not_read",
                   "a lens_model is published for " + topic + ", but none was taken",
                   "look at the node's warnings: rosconsole or /rosout");
  if (images.lens_width > 0 &&
      (images.lens_width != images.width || images.lens_height != images.height))
    findings.error("size_mismatch",
                   "the lens was calibrated at " + std::to_string(images.lens_width) + "x" +
                       std::to_string(images.lens_height) + ", the images on " + topic + " are " +
                       std::to_string(images.width) + "x" + std::to_string(images.height),
                   "set the camera back to that size (no binning, no region of interest), or "
                   "calibrate at this "
                   "one");
  if (images.mean_level && *images.mean_level < kDark)
    findings.error("dark_images", "images on " + topic + " are black",
                   "take off the lens cap; raise ~exposure_us or ~gain");
  else if (images.saturated_fraction && *images.saturated_fraction > kSaturated)
    findings.error("saturated_images",
                   number(100.0 * *images.saturated_fraction, "%.0f") + " % of the pixels on " +
                       topic + " are saturated",
                   "lower ~exposure_us or ~gain");
  (void)facts;
}

/// Why frames are lost on their way.
void drops(const DoctorFacts& facts, const DoctorFacts::Images& images, Findings& findings) {
  double bad = 0.0;
  for (const char* name : {"incomplete", "underruns", "lost"}) bad += count(images.counts, name);
  const double good = std::max(1.0, count(images.counts, "published"));
  const double missing = count(images.counts, "missing packets");
  if (bad + missing <= 0.0 || (bad / good < kLossWorthATell && missing / good < kLossWorthATell))
    return;
  const double bytes = images.rate * images.width * images.height * bytesPerPixel(images.encoding);
  const std::string lost = number(bad, "%.0f") + " frames and " + number(missing, "%.0f") +
                           " packets lost on " + images.topic;
  if (facts.link_bytes_per_s && bytes > kWorkingShare * *facts.link_bytes_per_s)
    findings.warning(
        "bandwidth",
        lost + ": " + bytesPerSecond(bytes) + " of images do not fit a link of " +
            bytesPerSecond(*facts.link_bytes_per_s),
        "lower ~frame_rate, choose an 8-bit Bayer or mono pixel_format, or one camera a "
        "link");
  else if (facts.socket_buffer && *facts.socket_buffer < kEnoughSocketBuffer)
    findings.warning("socket_buffer",
                     lost + ": sockets get at most " +
                         number(*facts.socket_buffer / 1024.0, "%.0f") + " KiB of receive buffer",
                     "sudo sysctl -w net.core.rmem_max=33554432");
  else if (facts.load > 1.5 * facts.cores)
    findings.warning(
        "cpu",
        lost + ": the load is " + number(facts.load) + " on " + std::to_string(facts.cores) +
            " cores",
        "stop other programs, lower ~frame_rate or the matcher's ~threads or ~max_rate");
  else if (facts.mtu && *facts.mtu <= 1500 && bytes > kHighBandwidth)
    findings.warning(
        "packet_size",
        lost + ": packets of " + std::to_string(*facts.mtu) + " bytes for " + bytesPerSecond(bytes),
        "sudo ip link set DEVICE mtu 9000 (the switch must allow it too), then start the "
        "camera again");
  else if (count(images.counts, "underruns") > 0.0)
    findings.warning("underruns", lost + ": the driver had no free buffer",
                     "lower ~frame_rate, or relieve the processor");
  else
    findings.warning("packet_loss", lost,
                     "check cable, connectors and switch; raise the delay between packets");
}

void stage(const DoctorFacts& facts, Findings& findings) {
  const DoctorFacts::Stage& stage = facts.stage;
  const DoctorFacts::Tf& tf = facts.tf;
  const std::string camera =
      facts.images.empty() ? "camera_optical" : facts.images.front().frame_id;
  if (stage.fault.find("ermission") != std::string::npos)
    return findings.error("stage_permission",
                          "the stage's port may not be opened: " + printable(stage.fault, 200),
                          "sudo usermod -aG dialout $USER, then log in again");
  if (!stage.fault.empty())
    return findings.error("stage_fault", "the stage reports: " + printable(stage.fault, 200),
                          "mend the cause, then rosservice call " + stage.ns + "/recover");
  if (!tf.connected) {
    if (!tf.fixed_known && !stage.published)
      return findings.error(
          "no_stage",
          "no stage publishes where the carriage is: tf has no frame " + facts.stereo.fixed_frame,
          "start the stage's node, or set the stereo node's ~fixed_frame to a "
          "frame that your robot has");
    if (!tf.fixed_known)
      return findings.error(
          "no_fixed_frame", "tf has no frame " + facts.stereo.fixed_frame + " (~fixed_frame)",
          "set ~fixed_frame of the stereo node, or ~frame_id of the stage, so that "
          "they agree");
    if (!tf.camera_known)
      return findings.error("no_camera_frame", "tf has no frame " + camera,
                            "roslaunch omnister camera.launch parent_frame_id:=stage_carriage "
                            "mount:=\"x y z qx qy qz qw\"");
    return findings.error("tf_not_connected",
                          "tf does not connect " + facts.stereo.fixed_frame + " with " + camera,
                          "publish how the camera hangs on the carriage: camera.launch "
                          "parent_frame_id:=stage_carriage mount:=\"x y z qx qy qz qw\"");
  }
  if (tf.age && std::abs(*tf.age) > kOldStamp)
    return findings.error("tf_old",
                          "the newest pose of " + camera + " in tf is " + number(*tf.age) +
                              " s from now: the stage went silent, or its clock differs",
                          "look whether the stage's node runs; bring the clocks together (chrony)");
  const auto& counts = facts.stereo.counts;
  if (count(counts, "no pose") > 0.0 && count(counts, "settled") == 0.0)
    return findings.error("no_pose_in_time",
                          "tf does not know where the camera was at the stamps of the images",
                          "raise ~max_wait of the stereo node; have the stage publish faster "
                          "(~rate); bring the clocks together");
  if (stage.limits_apart && *stage.limits_apart < facts.stereo.min_baseline)
    return findings.error("travel_too_short",
                          "the stage may travel " + number(*stage.limits_apart) +
                              " m, less than ~min_baseline, " + number(facts.stereo.min_baseline) +
                              " m",
                          "lower ~min_baseline of the stereo node, or widen ~min_m and ~max_m of "
                          "the stage");
  if (count(counts, "moving") > 0.0 && count(counts, "settled") == 0.0)
    return findings.error("never_settles", "the camera moves in every image (~settle_time)",
                          "let the stage rest at each position; for a stage that scans without "
                          "stops: rosparam set " +
                              facts.stereo.node + "/settle_time 0");
  if (count(counts, "no baseline") > 0.0 && count(counts, "paired") == 0.0) {
    const auto& missed = facts.stereo.missed_baseline;
    if (missed && *missed < facts.stereo.min_baseline)
      return findings.error("baseline_too_short",
                            "the camera moved " + number(*missed) +
                                " m, less than ~min_baseline, " +
                                number(facts.stereo.min_baseline) + " m",
                            "move the stage further, or lower ~min_baseline");
    if (missed && *missed > facts.stereo.max_baseline)
      return findings.error("baseline_too_long",
                            "the camera moved " + number(*missed) +
                                " m, more than ~max_baseline, " +
                                number(facts.stereo.max_baseline) + " m",
                            "move the stage in shorter steps, or raise ~max_baseline");
    if (!stage.homed)
      return findings.error("stage_not_homed",
                            "the stage is not homed and stands still: there is one position only",
                            "rosservice call " + stage.ns + "/home, then move it");
    return findings.error(
        "stage_not_moving", "the camera has been at one position only: there is no baseline",
        "move the stage: rostopic pub -1 " + stage.ns +
            "/move_stage/goal omnister/MoveStageActionGoal '{goal: {position: 0.1}}'");
  }
}

void rig(const DoctorFacts& facts, Findings& findings) {
  const auto& counts = facts.stereo.counts;
  if (count(counts, "no pose") > 0.0)
    return findings.error(
        "no_rig_pose", "the pose between the two cameras is not known: no ~rig, none in tf",
        "omnister calibrate-stereo …, then stereo.launch mode:=rig rig:=RIG.yaml");
  if (facts.skew && *facts.skew > facts.stereo.max_skew)
    return findings.error("not_synchronous",
                          "left and right images are " + number(1e3 * *facts.skew) +
                              " ms apart, ~max_skew is " + number(1e3 * facts.stereo.max_skew) +
                              " ms",
                          "trigger both cameras together; for a scene that stands still raise "
                          "~max_skew");
}

void cloud(const DoctorFacts& facts, Findings& findings) {
  const DoctorFacts::Stereo& stereo = facts.stereo;
  if (stereo.clouds == 0) {
    if (count(stereo.counts, "bad lens") > 0.0)
      return findings.error("bad_lens", "the lens on lens_model is broken: " + stereo.summary,
                            "calibrate again, or import the lens again");
    if (count(stereo.counts, "failed") > 0.0)
      return findings.error("matching_failed", "matching fails: " + printable(stereo.summary, 300),
                            "mend what it says; parameters are in docs/nodes.md");
    if (facts.free_memory_mb && *facts.free_memory_mb < kLittleMemory)
      return findings.error(
          "no_memory",
          "programs can have " + number(*facts.free_memory_mb, "%.0f") + " MB of memory only",
          "stop other programs, or halve the images (binning)");
    return findings.error(
        "no_cloud",
        "no cloud came" +
            (stereo.summary.empty() ? std::string() : ": " + printable(stereo.summary, 300)),
        "rostopic echo /diagnostics; wait longer: omnister doctor --seconds 30");
  }
  if (stereo.valid_fraction >= kFewValid) return;
  const auto most =
      std::max_element(stereo.rejected.begin(), stereo.rejected.end(),
                       [](const auto& a, const auto& b) { return a.second < b.second; });
  const std::string share =
      number(100.0 * stereo.valid_fraction, "%.1f") + " % of the pixels have a range";
  if (most == stereo.rejected.end())
    return findings.error("empty_clouds", share, "look at the images and at the topic epipolar");
  const std::string cause = share + "; most are rejected by the test '" + most->first + "'";
  const std::string& test = most->first;
  if (test == "masked")
    return findings.error("all_masked", cause,
                          "the ~mask leaves out nearly everything: 0 leaves out");
  if (test == "range limits" || test == "at_limit")
    return findings.error("all_out_of_range", cause,
                          "widen ~min_range and ~max_range of the stereo node");
  if (test == "parallax" || test == "no_parallax")
    return findings.error("all_without_parallax", cause,
                          "the scene is too far for this baseline: move the camera further");
  if (test == "left-right")
    return findings.error("all_inconsistent", cause,
                          "the poses or the lens are wrong, or the scene moves: look at the topic "
                          "epipolar; calibrate again; check ~axis and ~unit_m of the stage");
  if (test == "speckle")
    return findings.error("all_speckle", cause, "look at the topic epipolar: is the pose right?");
  return findings.error(
      "all_unmatched", cause,
      "the images do not show the same texture along the epipolar curves: look at "
      "the topic epipolar, at focus and exposure, and at ~min_range");
}

}  // namespace

std::string severityName(Severity severity) {
  switch (severity) {
    case Severity::kNote:
      return "note";
    case Severity::kWarning:
      return "warning";
    case Severity::kError:
      return "error";
  }
  return "error";
}

std::vector<Finding> diagnose(const DoctorFacts& facts) {
  Findings findings;
  if (!facts.master) {
    findings.error("no_master", "no ROS master answers at " + printable(facts.master_uri),
                   "roslaunch starts one; or set ROS_MASTER_URI to that of the robot");
    return findings.take();
  }
  if (!facts.registered) {
    findings.error("master_restarted",
                   "the ROS master was started anew and knows nobody who was there before: topics "
                   "that are joined go "
                   "on, new listeners find nothing",
                   "launch the nodes again");
    return findings.take();
  }
  machine(facts, findings);
  if (findings.failed()) return findings.take();
  const DoctorFacts::Stereo& stereo = facts.stereo;
  if (stereo.node.empty()) {
    findings.error("no_stereo_node", "no stereo node runs: nobody publishes points2",
                   "roslaunch omnister stereo.launch");
  } else if (!stereo.answers) {
    findings.error("stereo_unreachable",
                   "the stereo node " + stereo.node +
                       " does not answer: it died, or its host name does not resolve here",
                   "rosnode cleanup, then roslaunch omnister stereo.launch");
  }
  for (const DoctorFacts::Images& images : facts.images) camera(facts, images, findings);
  if (!findings.failed() && stereo.clouds == 0) {
    if (stereo.rig)
      rig(facts, findings);
    else
      stage(facts, findings);
  }
  if (!findings.failed() && stereo.listened_to) cloud(facts, findings);
  for (const DoctorFacts::Images& images : facts.images) drops(facts, images, findings);
  if (stereo.drift) {
    findings.warning(
        "calibration_drift",
        "features lie " + number(stereo.drift_px, "%.2f") +
            " px off their epipolar curves: lens or pose is no longer that of the rig",
        "see which with `omnister evaluate board` and `omnister evaluate pair`, tighten "
        "what is loose, and calibrate again: roslaunch omnister calibrate.launch");
  }
  const double busy = count(stereo.counts, "busy");
  const double rate = facts.images.empty() ? 0.0 : facts.images.front().rate;
  // With a limit on the rate the matcher is idle in between, which is no news.
  if (busy / (busy + std::max(1, stereo.clouds)) > kBusyShare && stereo.seconds * rate > 1.0)
    findings.note("matcher_busy",
                  "most sets of images are dropped because the matcher is busy: a cloud takes " +
                      number(stereo.seconds) + " s",
                  "nothing is wrong with a stage that rests; else lower the frame rate, or choose "
                  "fewer positions or hypotheses");
  return findings.take();
}

}  // namespace omnister
