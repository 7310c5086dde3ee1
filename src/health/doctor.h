// SPDX-License-Identifier: Apache-2.0
/// @file Why there is no cloud, or why frames drop, and what to type to mend it. A pure function of
/// facts: gathering them is another file (doctor_facts.h). Knows no ROS.
#pragma once

#include <map>
#include <optional>
#include <string>
#include <vector>

namespace omnister {

/// What was found out about a running rig. A fact that could not be found out keeps its default,
/// which accuses nobody.
struct DoctorFacts {
  // The machine and the master.
  bool master = true;  ///< answers
  std::string master_uri;
  bool sim_time = false;         ///< parameter /use_sim_time
  bool registered = true;        ///< the master knows the doctor, who told it once
  bool clock_published = false;  ///< somebody publishes /clock
  int cores = 1;
  double load = 0.0;                       ///< of the last minute
  std::optional<double> free_memory_mb;    ///< that programs can still have
  std::optional<double> socket_buffer;     ///< largest receive buffer of a socket [bytes]
  std::optional<double> link_bytes_per_s;  ///< speed of the network towards the camera
  std::optional<int> mtu;                  ///< of that network [bytes]

  struct Stereo {
    std::string node;  ///< empty: there is none
    std::string ns;    ///< of its topics, e.g. "/camera"
    bool answers = true;
    bool rig = false;  ///< mode: two cameras
    bool listened_to = true;
    std::string fixed_frame = "stage_base";
    double min_baseline = 0.01, max_baseline = 1.0, max_skew = 0.02;  ///< [m], [m], [s]
    std::string summary;                                              ///< of its diagnostics
    std::map<std::string, double>
        counts;  ///< of its diagnostics: how much each grew while we looked
    std::optional<double> missed_baseline;   ///< nearest to the limits that was not within them [m]
    int clouds = 0;                          ///< that came
    double valid_fraction = 1.0;             ///< of the last cloud
    std::map<std::string, double> rejected;  ///< pixels of the last cloud by test
    double seconds = 0.0;                    ///< of the last cloud
    bool drift = false;     ///< features lie off their epipolar curves, beyond doubt
    double drift_px = 0.0;  ///< so far
  } stereo;

  /// The image topic; in mode rig that of the left and of the right camera.
  struct Images {
    std::string topic;  ///< empty: not known
    std::vector<std::string> publishers;
    bool publisher_answers = true;
    std::optional<int> received;  ///< while we listened; none: we did not
    double rate = 0.0;            ///< [Hz]
    int width = 0, height = 0;
    std::string encoding = "mono8", frame_id = "camera_optical";
    bool stamped = true;
    double age = 0.0;                          ///< now less the stamp, median [s]
    std::optional<double> mean_level;          ///< 0 to 1, of the image circle
    std::optional<double> saturated_fraction;  ///< 0 to 1
    bool lens_published = true;                ///< lens_model has a publisher
    bool lens = true;                          ///< a lens is known, from a file or a topic
    int lens_width = 0, lens_height = 0;       ///< 0: not known
    /// The camera driver, if it is ours, from its diagnostics.
    bool driver = false;
    std::string driver_node, driver_state, driver_problem, device, trigger = "off", link;
    std::map<std::string, double> counts;  ///< of its diagnostics: how much each grew
  };
  std::vector<Images> images;
  std::optional<double> skew;  ///< rig: between stamps of left and right, median [s]

  struct Tf {
    bool fixed_known = true, camera_known = true, connected = true;
    std::optional<double> age;  ///< now less the newest common time [s]; none for a static one
  } tf;

  struct Stage {
    bool published = true;  ///< a stage_state or joint_states has a publisher
    std::string node;
    std::string ns = "/stage";  ///< of its topics, action and services
    bool homed = true, moving = false;
    double moving_share = 0.0;  ///< of the readings, 0 to 1
    std::string fault;
    double travel_seen = 1.0;  ///< between the least and the largest position that came [m]
    std::optional<double> limits_apart;  ///< max_m - min_m [m]
  } stage;
};

struct Finding {
  enum class Severity { kNote, kWarning, kError };
  std::string code;  ///< short, stable, for programs: "no_lens"
  Severity severity = Severity::kError;
  std::string cause;  ///< one sentence with the evidence
  std::string mend;   ///< what to type or to do
};

/// @return causes before their consequences; what follows from an earlier cause is left out. Empty:
/// all is well.
std::vector<Finding> diagnose(const DoctorFacts& facts);

/// "error", "warning" or "note".
std::string severityName(Finding::Severity severity);

}  // namespace omnister
