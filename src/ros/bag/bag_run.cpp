// SPDX-License-Identifier: Apache-2.0
#include "ros/bag/bag_run.h"

#include <message_filters/sync_policies/approximate_time.h>
#include <message_filters/synchronizer.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <tf2/buffer_core.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "omnister/calibration/rig_file.h"
#include "omnister/common/error.h"
#include "ros/bag/bag_check.h"
#include "ros/message/conversions.h"
#include "ros/message/image_input.h"
#include "ros/message/messages.h"
#include "ros/stereo/message_frame.h"

namespace omnister {
namespace {

constexpr double kTfMargin = 60.0;  // [s] that stamps may lie outside the bag's own time

std::string namespaceOf(const std::string& topic) { return topic.substr(0, topic.rfind('/') + 1); }

WorkerSettings settingsOf(const BagRunOptions& options) {
  WorkerSettings settings;
  settings.matcher = options.matcher;
  settings.matching = options.matching;
  return settings;
}

class BagRun {
 public:
  BagRun(const std::filesystem::path& path, const BagRunOptions& options,
         const std::function<bool(std::int64_t)>& wanted,
         const std::function<void(const BagCloud&)>& take, const Progress& progress)
      : source_(path.string()),
        options_(options),
        wanted_(wanted),
        take_(take),
        progress_(progress),
        pairing_(options.pairing),
        worker_(settingsOf(options)) {
    open(path);
  }

  BagRunSummary run() {
    findTopics();
    readLenses();
    readPosesAndLensTopics();
    readImages();
    summary_.frames = {pairing_.counts().begin(), pairing_.counts().end()};
    return std::move(summary_);
  }

 private:
  using Policy =
      message_filters::sync_policies::ApproximateTime<sensor_msgs::Image, sensor_msgs::Image>;

  void open(const std::filesystem::path& path) {
    const BagFacts facts = checkBag(path);
    if (facts.untimed > 0) summary_.dropped["message recorded at time 0"] = facts.untimed;
    try {
      bag_.open(source_, rosbag::bagmode::Read);
    } catch (const std::exception& error) {
      throw InputError(source_, "", "is not a whole bag: " + printable(error.what()));
    }
  }

  void findTopics() {
    std::set<std::string> images;
    rosbag::View view(bag_);
    for (const rosbag::ConnectionInfo* connection : view.getConnections())
      if (connection->datatype == "sensor_msgs/Image") images.insert(connection->topic);
    const double span =
        view.size() > 0 ? view.getEndTime().toSec() - view.getBeginTime().toSec() : 0.0;
    tf_ = std::make_unique<tf2::BufferCore>(ros::Duration(std::clamp(span, 0.0, 1e8) + kTfMargin));
    std::string list;
    for (const std::string& topic : images) list += (list.empty() ? "" : ", ") + printable(topic);
    if (list.empty()) list = "none";
    topics_ = {options_.image};
    if (options_.rig) topics_.push_back(options_.right_image);
    if (topics_[0].empty() && !options_.rig && images.size() == 1) topics_[0] = *images.begin();
    for (const std::string& topic : topics_) {
      if (topic.empty())
        throw InputError(source_, "",
                         "which images to take is not said; its image topics: " + list);
      if (images.count(topic) == 0)
        throw InputError(source_, printable(topic), "is no image topic of it; these are: " + list);
    }
    if (options_.rig && topics_[0] == topics_[1])
      throw InputError(source_, topics_[0], "cannot be left and right image at once");
  }

  void readLenses() {
    std::string files[] = {options_.lens, options_.lens_displaced};
    if (options_.rig && !options_.rig_file.empty()) {
      const RigFile rig = readRigFile(options_.rig_file);
      T_left_right_ = rig.T_ref_disp;
      if (files[0].empty()) files[0] = rig.reference.string();
      if (files[1].empty()) files[1] = rig.displaced.string();
    }
    lenses_.resize(topics_.size());
    for (std::size_t i = 0; i < lenses_.size(); ++i)
      if (!files[i].empty()) lenses_[i] = readLensFile(files[i]);
  }

  /// Nothing where the message is not what it should be, and of what kind it is then.
  template <typename Message>
  static boost::shared_ptr<const Message> read(const rosbag::MessageInstance& instance,
                                               std::string* problem) {
    try {
      if (auto message = instance.instantiate<Message>()) return message;
      *problem = "message of another type on " + instance.getTopic();
    } catch (const std::exception&) {
      *problem = "broken message on " + instance.getTopic();
    }
    return nullptr;
  }

  template <typename Message>
  boost::shared_ptr<const Message> instantiate(const rosbag::MessageInstance& instance) {
    std::string problem;
    auto message = read<Message>(instance, &problem);
    if (!message) drop(problem);
    return message;
  }

  void drop(const std::string& reason) { ++summary_.dropped[printable(reason, 300)]; }

  /// Bag and view throw their own kinds of exceptions where the file is damaged.
  template <typename Visit>
  void forEach(const std::vector<std::string>& topics, const std::string& stage, double from,
               double to, const Visit& visit) {
    try {
      rosbag::View view(bag_, rosbag::TopicQuery(topics));
      const std::size_t count = std::max<std::size_t>(1, view.size());
      std::size_t index = 0;
      for (const rosbag::MessageInstance& instance : view) {
        visit(instance);
        if (progress_) progress_(from + (to - from) * static_cast<double>(++index) / count, stage);
      }
    } catch (const rosbag::BagException& error) {
      throw InputError(source_, "", "is damaged: " + printable(error.what()));
    }
  }

  /// Whether a stamp can be of this recording. One that is decades off would push all others out of
  /// tf, and differences of stamps with it are no durations for ROS.
  bool isNear(const ros::Time& stamp) const {
    constexpr double kFarthest = 9e8;  // [s]
    return canReckonWith(stamp) &&
           (!middle_stamp_ || std::abs(stamp.toSec() - *middle_stamp_) < kFarthest);
  }

  void findMiddleStamp() {
    std::vector<double> stamps;
    forEach({"/tf", "tf"}, "reading poses", 0.0, 0.02, [&](const rosbag::MessageInstance& one) {
      std::string unused;
      if (const auto message = read<tf2_msgs::TFMessage>(one, &unused))
        for (const auto& transform : message->transforms)
          stamps.push_back(transform.header.stamp.toSec());
    });
    if (stamps.empty()) return;
    const auto middle = stamps.begin() + static_cast<std::ptrdiff_t>(stamps.size() / 2);
    std::nth_element(stamps.begin(), middle, stamps.end());
    middle_stamp_ = *middle;
  }

  void readPosesAndLensTopics() {
    findMiddleStamp();
    std::vector<std::string> topics = {"/tf", "/tf_static", "tf", "tf_static"};
    std::map<std::string, std::size_t> eye_of_topic;
    std::vector<ros::Time> stamps(lenses_.size());
    for (std::size_t i = 0; i < lenses_.size(); ++i) {
      if (lenses_[i]) continue;
      eye_of_topic[namespaceOf(topics_[i]) + "lens_model"] = i;
      topics.push_back(namespaceOf(topics_[i]) + "lens_model");
    }
    forEach(topics, "reading poses", 0.02, 0.05, [&](const rosbag::MessageInstance& instance) {
      const auto eye = eye_of_topic.find(instance.getTopic());
      if (eye == eye_of_topic.end()) {
        const auto message = instantiate<tf2_msgs::TFMessage>(instance);
        if (!message) return;
        const bool fixed = instance.getTopic().find("tf_static") != std::string::npos;
        for (const auto& transform : message->transforms) addTransform(transform, fixed);
        return;
      }
      const auto message = instantiate<LensModelMessage>(instance);
      // As live: the latest by its stamp.
      if (!message || (lenses_[eye->second] && message->header.stamp < stamps[eye->second])) return;
      try {
        lenses_[eye->second] = fromLensModelMessage(*message, instance.getTopic());
        stamps[eye->second] = message->header.stamp;
      } catch (const Error& error) {
        drop(error.what());
      }
    });
    for (std::size_t i = 0; i < lenses_.size(); ++i)
      if (!lenses_[i])
        throw InputError(source_, namespaceOf(topics_[i]) + "lens_model",
                         "holds no lens: give a lens file (--lens)");
  }

  void addTransform(const geometry_msgs::TransformStamped& transform, bool fixed) {
    // What is fixed holds at all times.
    bool taken = fixed ? canReckonWith(transform.header.stamp) : isNear(transform.header.stamp);
    try {
      taken = taken && tf_->setTransform(transform, "bag", fixed);
    } catch (const std::exception&) {
      taken = false;
    }
    if (!taken) drop("transform that tf refuses");
  }

  void readImages() {
    std::optional<std::pair<double, double>> span;
    std::size_t good = 0;
    if (options_.rig) beginPairs();
    forEach(topics_, "matching", 0.05, 1.0, [&](const rosbag::MessageInstance& instance) {
      const sensor_msgs::ImageConstPtr image = instantiate<sensor_msgs::Image>(instance);
      if (!image) return;
      ++summary_.images;
      const std::size_t eye = instance.getTopic() == topics_[0] ? 0 : 1;
      try {
        checkFrame(*image, lenses_[eye]->image_size, instance.getTopic());
        if (!isNear(image->header.stamp))
          throw InputError(instance.getTopic(), "header.stamp", "is decades off the others");
      } catch (const Error& error) {
        return drop(error.what());
      }
      ++good;
      const double stamp = image->header.stamp.toSec();
      if (!middle_stamp_) middle_stamp_ = stamp;
      span = span ? std::make_pair(std::min(span->first, stamp), std::max(span->second, stamp))
                  : std::make_pair(stamp, stamp);
      if (options_.rig)
        addToPairs(image, eye);
      else
        matchStage(image);
    });
    if (!span) return;
    summary_.recorded_seconds = span->second - span->first;
    if (!options_.rig) return;
    endPairs(span->second);
    const std::size_t alone = good - std::min(good, 2 * summary_.sets);
    if (alone > 0) summary_.dropped["image without one of the other camera"] = alone;
  }

  void beginPairs() {
    Policy policy(8);
    policy.setMaxIntervalDuration(ros::Duration(options_.max_skew));
    synchronizer_ =
        std::make_unique<message_filters::Synchronizer<Policy>>(static_cast<const Policy&>(policy));
    synchronizer_->registerCallback(&BagRun::keepPair, this);
  }

  void keepPair(const sensor_msgs::ImageConstPtr& left, const sensor_msgs::ImageConstPtr& right) {
    if (!left->data.empty() && !right->data.empty()) pairs_.emplace_back(left, right);
  }

  void addToPairs(const sensor_msgs::ImageConstPtr& image, std::size_t eye) {
    const ros::MessageEvent<const sensor_msgs::Image> event(image, image->header.stamp);
    if (eye == 0)
      synchronizer_->add<0>(event);
    else
      synchronizer_->add<1>(event);
    for (const auto& [left, right] : std::exchange(pairs_, {})) matchRig(left, right);
  }

  /// A pair goes out when what comes later shows that nothing fits better: so comes what has no
  /// picture.
  void endPairs(double newest) {
    const auto end = boost::make_shared<sensor_msgs::Image>();
    end->header.stamp.fromSec(newest + 10.0);
    addToPairs(end, 0);
    addToPairs(end, 1);
  }

  PoseAnswer cameraPose(const std::string& frame_id, std::int64_t stamp_ns) const {
    PoseAnswer answer;  // all of tf is known: what is not there will never come
    try {
      ros::Time stamp;
      stamp.fromNSec(static_cast<std::uint64_t>(stamp_ns));
      answer.T_fixed_camera = fromTransform(
          tf_->lookupTransform(options_.fixed_frame, frame_id, stamp).transform, "tf");
      answer.state = PoseAnswer::State::kKnown;
    } catch (const std::exception& error) {
      answer.reason = printable(error.what(), 300);
    }
    return answer;
  }

  void matchStage(const sensor_msgs::ImageConstPtr& image) {
    PairingFrame frame;
    frame.stamp_ns = static_cast<std::int64_t>(image->header.stamp.toNSec());
    frame.frame_id = image->header.frame_id;
    frame.image = toStereoFrame(image);
    const std::int64_t now = frame.stamp_ns;
    pairing_.add(std::move(frame), now);
    const std::optional<FrameSet> found = pairing_.poll(
        [this](const std::string& id, std::int64_t stamp) { return cameraPose(id, stamp); }, now);
    if (found) match(toStereoSet(*found));
  }

  void matchRig(const sensor_msgs::ImageConstPtr& left, const sensor_msgs::ImageConstPtr& right) {
    StereoSet set;
    set.reference = toStereoFrame(left);
    set.displaced = {toStereoFrame(right)};
    try {
      set.T_ref_disp = {
          T_left_right_ ? *T_left_right_
                        : fromTransform(tf_->lookupTransform(left->header.frame_id,
                                                             right->header.frame_id, ros::Time(0))
                                            .transform,
                                        "tf")};
    } catch (const std::exception& error) {
      return drop(std::string("no pose between the cameras: ") + error.what());
    }
    match(set);
  }

  void match(const StereoSet& set) {
    ++summary_.sets;
    BagCloud result;
    result.stamp_ns = set.reference->stampNs();
    if (!wanted_(result.stamp_ns)) {
      ++summary_.skipped;
      return;
    }
    const auto start = std::chrono::steady_clock::now();
    try {
      const PreparedSet prepared =
          worker_.prepare(set, *lenses_.front(), *lenses_.back(), topics_.front(), topics_.back());
      const MatchedSet matched = *worker_.match(set, prepared);  // no stream
      result.match = matched.result;
      result.cloud = makeCloud(result.match, worker_.rays(matched), worker_.picture(matched, true),
                               options_.matching.threads);
    } catch (const Error& error) {
      return drop(error.what());
    }
    result.seconds =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    result.frame_id = messageOf(*set.reference).header.frame_id;
    result.positions = set.displaced.size();
    for (const Pose& pose : set.T_ref_disp)
      result.baseline_m = std::max(result.baseline_m, pose.translation().norm());
    take_(result);
  }

  const std::string source_;
  const BagRunOptions& options_;
  const std::function<bool(std::int64_t)>& wanted_;
  const std::function<void(const BagCloud&)>& take_;
  const Progress& progress_;
  rosbag::Bag bag_;
  std::vector<std::string> topics_;              ///< of the images
  std::vector<std::optional<LensFile>> lenses_;  ///< by topic
  std::optional<Pose> T_left_right_;
  std::unique_ptr<tf2::BufferCore> tf_;
  std::optional<double> middle_stamp_;  ///< of all of tf; without tf, of the first image [s]
  FramePairing pairing_;
  std::unique_ptr<message_filters::Synchronizer<Policy>> synchronizer_;  ///< of a rig
  std::vector<std::pair<sensor_msgs::ImageConstPtr, sensor_msgs::ImageConstPtr>> pairs_;
  StereoWorker worker_;
  BagRunSummary summary_;
};

}  // namespace

BagRunSummary runBag(const std::filesystem::path& bag, const BagRunOptions& options,
                     const std::function<bool(std::int64_t)>& wanted,
                     const std::function<void(const BagCloud&)>& take, const Progress& progress) {
  return BagRun(bag, options, wanted, take, progress).run();
}

}  // namespace omnister
