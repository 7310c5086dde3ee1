// SPDX-License-Identifier: Apache-2.0
// The doctor's judgement, on facts as they are when one thing is broken.
#include "health/doctor.h"

#include <gmock/gmock.h>

#include <functional>
#include <set>

namespace omnister {
namespace {

/// A rig in good health, with one camera on a stage.
DoctorFacts healthy() {
  DoctorFacts facts;
  facts.master_uri = "http://localhost:11311";
  facts.cores = 4;
  facts.load = 1.0;
  facts.free_memory_mb = 4000.0;
  facts.socket_buffer = 33e6;
  facts.link_bytes_per_s = 125e6;
  facts.mtu = 9000;
  facts.stereo.node = "/camera/stereo";
  facts.stereo.ns = "/camera";
  facts.stereo.clouds = 5;
  facts.stereo.valid_fraction = 0.8;
  facts.stereo.counts = {{"received", 25}, {"settled", 20}, {"paired", 5}};
  DoctorFacts::Images images;
  images.topic = "/camera/image_raw";
  images.publishers = {"/camera/driver"};
  images.received = 25;
  images.rate = 5.0;
  images.width = 1280;
  images.height = 960;
  images.lens_width = 1280;
  images.lens_height = 960;
  images.mean_level = 0.4;
  images.saturated_fraction = 0.01;
  images.driver = true;
  images.driver_node = "/camera/driver";
  images.driver_state = "streaming";
  images.device = "aravis:1234";
  images.counts = {{"published", 25}};
  facts.images = {images};
  facts.stage.node = "/stage/driver";
  facts.stage.limits_apart = 0.3;
  facts.tf.age = 0.02;
  return facts;
}

DoctorFacts healthyRig() {
  DoctorFacts facts = healthy();
  facts.stereo.rig = true;
  facts.images.push_back(facts.images.front());
  facts.images[0].topic = "/camera/left/image_raw";
  facts.images[1].topic = "/camera/right/image_raw";
  facts.skew = 0.001;
  return facts;
}

using Seed = std::function<void(DoctorFacts&)>;

/// The camera's driver sends nothing, and says why.
Seed silentDriver(const std::string& state, const std::string& problem) {
  return [=](DoctorFacts& facts) {
    facts.images[0].received = 0;
    facts.images[0].driver_state = state;
    facts.images[0].driver_problem = problem;
  };
}

/// All frames come to this end at the stereo node. @param more what else is wrong
Seed framesEnd(const std::string& where, const Seed& more = {}) {
  return [=](DoctorFacts& facts) {
    facts.stereo.counts = {{"received", 20}, {where, 20}};
    if (where == "no baseline") facts.stereo.counts["settled"] = 20;
    if (more) more(facts);
  };
}

struct Fault {
  const char* code;
  Seed seed;
  const char* mend;  ///< part of what is to be done
};

/// No cloud comes while any of these is there.
void noCloud(DoctorFacts& facts) {
  facts.stereo.clouds = 0;
  facts.stereo.counts["paired"] = 0;
}

const std::vector<Fault>& stageFaults() {
  static const std::vector<Fault> faults = {
      {"no_master", [](DoctorFacts& f) { f.master = false; }, "ROS_MASTER_URI"},
      {"no_clock", [](DoctorFacts& f) { f.sim_time = true; }, "use_sim_time"},
      {"no_stereo_node", [](DoctorFacts& f) { f.stereo.node.clear(); }, "stereo.launch"},
      {"stereo_unreachable", [](DoctorFacts& f) { f.stereo.answers = false; }, "rosnode cleanup"},
      {"no_camera", [](DoctorFacts& f) { f.images[0].publishers.clear(); }, "camera.launch"},
      {"publisher_unreachable", [](DoctorFacts& f) { f.images[0].publisher_answers = false; },
       "ROS_IP"},
      {"two_publishers", [](DoctorFacts& f) { f.images[0].publishers.push_back("/other"); },
       "namespace"},
      {"camera_permission", silentDriver("opening", "/dev/video0: Permission denied"), "video"},
      {"camera_busy", silentDriver("opening", "another program controls it"), "close it"},
      {"camera_absent", silentDriver("lost", "no frame for 3 s"), "cable"},
      {"camera_waits_for_trigger",
       [](DoctorFacts& f) {
         f.images[0].received = 0;
         f.images[0].trigger = "line0";
       },
       "trigger off"},
      {"no_images", [](DoctorFacts& f) { f.images[0].received = 0; }, "rostopic hz"},
      {"no_stamp", [](DoctorFacts& f) { f.images[0].stamped = false; }, "driver"},
      {"clocks_differ", [](DoctorFacts& f) { f.images[0].age = -3600.0; }, "chrony"},
      {"no_frame_id", [](DoctorFacts& f) { f.images[0].frame_id.clear(); }, "frame_id"},
      {"bad_encoding", [](DoctorFacts& f) { f.images[0].encoding = "32FC1"; }, "pixel_format"},
      {"no_lens",
       [](DoctorFacts& f) {
         f.images[0].lens = f.images[0].lens_published = false;
         f.images[0].lens_width = f.images[0].lens_height = 0;
       },
       "calibrate.launch"},
      {"lens_not_read",
       [](DoctorFacts& f) {
         f.images[0].lens = false;
         f.images[0].lens_width = f.images[0].lens_height = 0;
       },
       "/rosout"},
      {"size_mismatch", [](DoctorFacts& f) { f.images[0].lens_width = 640; }, "calibrate"},
      {"dark_images", [](DoctorFacts& f) { f.images[0].mean_level = 0.003; }, "lens cap"},
      {"saturated_images", [](DoctorFacts& f) { f.images[0].saturated_fraction = 0.9; },
       "exposure_us"},
      {"stage_permission",
       [](DoctorFacts& f) { f.stage.fault = "no stage: /dev/ttyUSB0: Permission denied"; },
       "dialout"},
      {"stage_fault", [](DoctorFacts& f) { f.stage.fault = "stalled"; }, "recover"},
      {"no_stage",
       [](DoctorFacts& f) {
         f.stage.published = false;
         f.tf.fixed_known = f.tf.connected = false;
       },
       "stage's node"},
      {"no_fixed_frame", [](DoctorFacts& f) { f.tf.fixed_known = f.tf.connected = false; },
       "fixed_frame"},
      {"no_camera_frame", [](DoctorFacts& f) { f.tf.camera_known = f.tf.connected = false; },
       "mount"},
      {"tf_not_connected", [](DoctorFacts& f) { f.tf.connected = false; }, "parent_frame_id"},
      {"tf_old", [](DoctorFacts& f) { f.tf.age = 60.0; }, "chrony"},
      {"no_pose_in_time", framesEnd("no pose"), "max_wait"},
      {"travel_too_short", [](DoctorFacts& f) { f.stage.limits_apart = 0.005; }, "min_baseline"},
      {"never_settles", framesEnd("moving"), "settle_time 0"},
      {"baseline_too_short",
       framesEnd("no baseline", [](DoctorFacts& f) { f.stereo.missed_baseline = 0.004; }),
       "further"},
      {"baseline_too_long",
       framesEnd("no baseline", [](DoctorFacts& f) { f.stereo.missed_baseline = 1.5; }), "shorter"},
      {"stage_not_homed", framesEnd("no baseline", [](DoctorFacts& f) { f.stage.homed = false; }),
       "home"},
      {"stage_not_moving", framesEnd("no baseline"), "move_stage"},
      {"bad_lens", [](DoctorFacts& f) { f.stereo.counts["bad lens"] = 1; }, "import"},
      {"matching_failed", [](DoctorFacts& f) { f.stereo.counts["failed"] = 3; }, "docs/nodes.md"},
      {"no_memory", [](DoctorFacts& f) { f.free_memory_mb = 90.0; }, "stop"},
      {"no_cloud", [](DoctorFacts&) {}, "--seconds"},
  };
  return faults;
}

TEST(Doctor, FindsNothingWrongWithAHealthyRig) {
  EXPECT_THAT(diagnose(healthy()), testing::IsEmpty());
  EXPECT_THAT(diagnose(healthyRig()), testing::IsEmpty());
}

TEST(Doctor, NamesWhyThereIsNoCloudAndWhatToDo) {
  std::set<std::string> codes;
  for (const Fault& fault : stageFaults()) {
    DoctorFacts facts = healthy();
    noCloud(facts);
    fault.seed(facts);
    const std::vector<Finding> findings = diagnose(facts);
    ASSERT_FALSE(findings.empty()) << fault.code;
    EXPECT_EQ(findings.front().code, fault.code) << findings.front().cause;
    EXPECT_EQ(findings.front().severity, Finding::Severity::kError) << fault.code;
    EXPECT_THAT(findings.front().mend, testing::HasSubstr(fault.mend)) << fault.code;
    EXPECT_FALSE(findings.front().cause.empty());
    EXPECT_EQ(findings.size(), 1u) << fault.code << ": consequences are left out";
    codes.insert(fault.code);
  }
  EXPECT_EQ(codes.size(), stageFaults().size());
  EXPECT_GE(codes.size(), 20u);
}

TEST(Doctor, NamesTheTestThatRejectsEveryPixel) {
  const std::map<std::string, std::string> expected = {
      {"masked", "all_masked"},           {"range limits", "all_out_of_range"},
      {"at_limit", "all_out_of_range"},   {"parallax", "all_without_parallax"},
      {"left-right", "all_inconsistent"}, {"speckle", "all_speckle"},
      {"no match", "all_unmatched"},      {"something new", "all_unmatched"}};
  for (const auto& [test, code] : expected) {
    DoctorFacts facts = healthy();
    facts.stereo.valid_fraction = 0.001;
    facts.stereo.rejected = {{"a little", 10}, {test, 900000}, {"zero", 0}};
    const std::vector<Finding> findings = diagnose(facts);
    ASSERT_EQ(findings.size(), 1u) << test;
    EXPECT_EQ(findings.front().code, code);
    EXPECT_THAT(findings.front().cause, testing::HasSubstr("'" + test + "'"));
  }
}

TEST(Doctor, NamesWhyFramesDrop) {
  const auto lossy = [] {
    DoctorFacts facts = healthy();
    facts.images[0].counts = {{"published", 100}, {"incomplete", 7}, {"missing packets", 60}};
    facts.images[0].rate = 60.0;  // 74 MB/s of mono8
    return facts;
  };
  const std::vector<Fault> faults = {
      {"bandwidth", [](DoctorFacts& f) { f.images[0].encoding = "bgr8"; }, "frame_rate"},
      {"socket_buffer", [](DoctorFacts& f) { f.socket_buffer = 212992; }, "net.core.rmem_max"},
      {"cpu", [](DoctorFacts& f) { f.load = 12.0; }, "threads"},
      {"packet_size", [](DoctorFacts& f) { f.mtu = 1500; }, "mtu 9000"},
      {"underruns", [](DoctorFacts& f) { f.images[0].counts["underruns"] = 5; }, "processor"},
      {"packet_loss", [](DoctorFacts&) {}, "cable"},
  };
  for (const Fault& fault : faults) {
    DoctorFacts facts = lossy();
    fault.seed(facts);
    const std::vector<Finding> findings = diagnose(facts);
    ASSERT_EQ(findings.size(), 1u) << fault.code;
    EXPECT_EQ(findings.front().code, fault.code) << findings.front().cause;
    EXPECT_EQ(findings.front().severity, Finding::Severity::kWarning);
    EXPECT_THAT(findings.front().mend, testing::HasSubstr(fault.mend));
  }
  DoctorFacts rare = healthy();
  rare.images[0].counts = {{"published", 100000}, {"incomplete", 1}};
  EXPECT_THAT(diagnose(rare), testing::IsEmpty());
}

TEST(Doctor, KnowsTheFaultsOfTwoCameras) {
  const std::vector<Fault> faults = {
      {"no_rig_pose", [](DoctorFacts& f) { f.stereo.counts["no pose"] = 9; }, "calibrate-stereo"},
      {"not_synchronous", [](DoctorFacts& f) { f.skew = 0.08; }, "trigger"},
      {"no_images", [](DoctorFacts& f) { f.images[1].received = 0; }, "right"},
      {"size_mismatch", [](DoctorFacts& f) { f.images[1].height = 720; }, "calibrate"},
  };
  for (const Fault& fault : faults) {
    DoctorFacts facts = healthyRig();
    noCloud(facts);
    fault.seed(facts);
    const std::vector<Finding> findings = diagnose(facts);
    ASSERT_EQ(findings.size(), 1u) << fault.code;
    EXPECT_EQ(findings.front().code, fault.code);
    EXPECT_THAT(findings.front().mend, testing::HasSubstr(fault.mend));
  }
}

TEST(Doctor, TellsThatTheMatcherCannotKeepUp) {
  DoctorFacts facts = healthy();
  facts.stereo.counts["busy"] = 40;
  facts.stereo.seconds = 1.7;
  const std::vector<Finding> findings = diagnose(facts);
  ASSERT_EQ(findings.size(), 1u);
  EXPECT_EQ(findings.front().code, "matcher_busy");
  EXPECT_EQ(findings.front().severity, Finding::Severity::kNote);
  EXPECT_THAT(findings.front().cause, testing::HasSubstr("1.7"));
}

TEST(Doctor, TellsOfACalibrationThatDrifted) {
  DoctorFacts facts = healthy();
  facts.stereo.drift = true;
  facts.stereo.drift_px = 0.83;
  const std::vector<Finding> findings = diagnose(facts);
  ASSERT_THAT(findings, testing::SizeIs(1));
  EXPECT_EQ(findings[0].code, "calibration_drift");
  EXPECT_THAT(findings[0].cause, testing::HasSubstr("0.83 px"));
}

TEST(Doctor, EvidenceFromOutsideIsPrintedSafely) {
  DoctorFacts facts = healthy();
  noCloud(facts);
  facts.stage.fault = "bad\x1b[2Jthing\n";
  EXPECT_THAT(diagnose(facts).front().cause, testing::Not(testing::HasSubstr("\x1b")));
}

}  // namespace
}  // namespace omnister
