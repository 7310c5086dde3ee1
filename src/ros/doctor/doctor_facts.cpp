// SPDX-License-Identifier: Apache-2.0
#include "ros/doctor/doctor_facts.h"

#include <arpa/inet.h>
#include <diagnostic_msgs/DiagnosticArray.h>
#include <fcntl.h>
#include <ifaddrs.h>
#include <netdb.h>
#include <poll.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <sys/socket.h>
#include <tf2_ros/buffer.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <mutex>
#include <opencv2/core.hpp>
#include <set>
#include <thread>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_file.h"
#include "ros/message/conversions.h"
#include "ros/message/image_input.h"
#include "ros/message/messages.h"
#include "ros/message/stereo_messages.h"
#include "ros/message/transform_input.h"

namespace omnister {
namespace {

std::string withoutSlash(const std::string& name) {
  return !name.empty() && name[0] == '/' ? name.substr(1) : name;
}

std::string folderOf(const std::string& topic) {
  const std::size_t slash = topic.rfind('/');
  return slash == std::string::npos ? "" : topic.substr(0, slash);
}

double median(std::vector<double> values) {
  if (values.empty()) return 0.0;
  std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
  return values[values.size() / 2];
}

std::optional<double> numberIn(const std::string& path) {
  std::ifstream file(path);
  std::string word;
  if (!(file >> word)) return std::nullopt;
  return parseNumber(word);
}

/// Network of the first IPv4 address that stands in the text: its MTU and speed.
void networkFacts(const std::string& text, DoctorFacts& facts) {
  in_addr device{};
  bool found = false;
  for (std::size_t i = 0; i < text.size() && !found; ++i) {
    const std::size_t end = text.find_first_not_of("0123456789.", i);
    const std::string word = text.substr(i, end == std::string::npos ? end : end - i);
    found = std::count(word.begin(), word.end(), '.') == 3 &&
            inet_pton(AF_INET, word.c_str(), &device) == 1;
  }
  ifaddrs* list = nullptr;
  if (!found || getifaddrs(&list) != 0) return;
  for (const ifaddrs* at = list; at != nullptr; at = at->ifa_next) {
    if (at->ifa_addr == nullptr || at->ifa_netmask == nullptr || at->ifa_addr->sa_family != AF_INET)
      continue;
    const auto address = reinterpret_cast<const sockaddr_in*>(at->ifa_addr)->sin_addr.s_addr;
    const auto mask = reinterpret_cast<const sockaddr_in*>(at->ifa_netmask)->sin_addr.s_addr;
    if ((address & mask) != (device.s_addr & mask)) continue;
    const std::string folder = "/sys/class/net/" + std::string(at->ifa_name);
    if (const auto mtu = numberIn(folder + "/mtu")) facts.mtu = static_cast<int>(*mtu);
    const auto megabits = numberIn(folder + "/speed");
    if (megabits && *megabits > 0.0) facts.link_bytes_per_s = *megabits * 125000.0;
    break;
  }
  freeifaddrs(list);
}

/// Who publishes and subscribes what, as the master tells.
class Graph {
 public:
  Graph() {
    XmlRpc::XmlRpcValue request, response, payload;
    request[0] = ros::this_node::getName();
    if (ros::master::execute("getSystemState", request, response, payload, false) &&
        payload.getType() == XmlRpc::XmlRpcValue::TypeArray && payload.size() >= 2) {
      read(payload[0], publishers_);
      read(payload[1], subscribers_);
    }
    if (ros::master::execute("getTopicTypes", request, response, payload, false) &&
        payload.getType() == XmlRpc::XmlRpcValue::TypeArray) {
      for (int i = 0; i < payload.size(); ++i)
        if (payload[i].size() == 2)
          types_[static_cast<std::string&>(payload[i][0])] =
              static_cast<std::string&>(payload[i][1]);
    }
  }
  std::vector<std::string> publishers(const std::string& topic) const {
    return nodes(publishers_, topic);
  }
  std::vector<std::string> subscribers(const std::string& topic) const {
    return nodes(subscribers_, topic);
  }
  std::string type(const std::string& topic) const {
    const auto found = types_.find(topic);
    return found == types_.end() ? "" : found->second;
  }
  /// Published topics of a type.
  std::vector<std::string> published(const std::string& type) const {
    return topics(publishers_, type, "");
  }
  /// Topics of a type that the node subscribes to.
  std::vector<std::string> subscribed(const std::string& node, const std::string& type) const {
    return topics(subscribers_, type, node);
  }

 private:
  using Table = std::map<std::string, std::vector<std::string>>;
  static void read(XmlRpc::XmlRpcValue& list, Table& table) {
    for (int i = 0; i < list.size(); ++i)
      for (int k = 0; k < list[i][1].size(); ++k)
        table[static_cast<std::string&>(list[i][0])].push_back(
            static_cast<std::string&>(list[i][1][k]));
  }
  static std::vector<std::string> nodes(const Table& table, const std::string& topic) {
    const auto found = table.find(topic);
    return found == table.end() ? std::vector<std::string>{} : found->second;
  }
  std::vector<std::string> topics(const Table& table, const std::string& type,
                                  const std::string& node) const {
    std::vector<std::string> result;
    for (const auto& [topic, nodes] : table) {
      if (this->type(topic) != type) continue;
      if (node.empty() || std::find(nodes.begin(), nodes.end(), node) != nodes.end())
        result.push_back(topic);
    }
    return result;
  }
  Table publishers_, subscribers_;
  std::map<std::string, std::string> types_;
};

/// Does the node with this name accept connections?
bool nodeAnswers(const std::string& node) {
  XmlRpc::XmlRpcValue request, response, uri;
  request[0] = ros::this_node::getName();
  request[1] = node;
  if (!ros::master::execute("lookupNode", request, response, uri, false)) return false;
  return answers(static_cast<std::string&>(uri));
}

/// What was heard on the topics.
class Ears {
 public:
  struct Status {
    std::string summary;
    std::map<std::string, std::string> values;
    std::map<std::string, double> first, last;
    int messages = 0;
    /// How much it grew; of a single message, all of it.
    double growth(const std::string& key) const {
      const auto end = last.find(key);
      if (end == last.end()) return 0.0;
      const auto begin = first.find(key);
      return end->second - (messages > 1 && begin != first.end() ? begin->second : 0.0);
    }
  };
  struct Images {
    std::vector<double> stamps, ages;
    sensor_msgs::ImageConstPtr last;
  };

  explicit Ears(std::size_t cameras) : images(cameras), lenses(cameras) {}

  void onDiagnostics(const diagnostic_msgs::DiagnosticArray::ConstPtr& array) {
    const std::lock_guard<std::mutex> lock(mutex);
    for (const auto& message : array->status) {
      Status& status = statuses[withoutSlash(message.name)];
      status.summary = message.message;
      ++status.messages;
      status.last.clear();
      for (const auto& value : message.values) {
        status.values[value.key] = value.value;
        if (const auto number = parseNumber(value.value)) status.last[value.key] = *number;
      }
      if (status.messages == 1) status.first = status.last;
    }
  }
  void onImage(std::size_t camera, const sensor_msgs::ImageConstPtr& image) {
    const std::lock_guard<std::mutex> lock(mutex);
    images[camera].stamps.push_back(image->header.stamp.toSec());
    images[camera].ages.push_back((ros::Time::now() - image->header.stamp).toSec());
    images[camera].last = image;
  }
  void onStage(const StageState::ConstPtr& state) {
    const std::lock_guard<std::mutex> lock(mutex);
    stages.push_back(*state);
  }

  std::mutex mutex;
  std::map<std::string, Status> statuses;
  std::vector<Images> images;
  std::vector<LensModelMessage::ConstPtr> lenses;
  std::vector<StageState> stages;
  sensor_msgs::PointCloud2::ConstPtr cloud;
  int clouds = 0;
};

double parameterOr(const std::string& name, double fallback) {
  double value = fallback;
  ros::param::param(name, value, fallback);
  return value;
}

std::string textOr(const std::string& name, const std::string& fallback) {
  std::string value;
  ros::param::param(name, value, fallback);
  return value;
}

void judgeImage(const sensor_msgs::ImageConstPtr& message, DoctorFacts::Images& images) {
  images.width = static_cast<int>(std::min<std::uint32_t>(message->width, 1u << 20));
  images.height = static_cast<int>(std::min<std::uint32_t>(message->height, 1u << 20));
  images.encoding = message->encoding;
  images.frame_id = message->header.frame_id;
  images.stamped = !message->header.stamp.isZero();
  try {
    checkImage(*message);
    const cv::Mat gray = toGray(*message, significantBits(*message));
    images.mean_level = cv::mean(gray)[0] / 255.0;
    images.saturated_fraction =
        static_cast<double>(cv::countNonZero(gray >= 250)) / static_cast<double>(gray.total());
  } catch (const std::exception&) {
    // The encoding or the size is judged by name.
  }
}

std::string statusNode(const std::string& status_name) {
  return status_name.substr(0, status_name.find(':'));
}

/// The driver whose diagnostics belong to this camera: that of the nearest namespace.
void judgeDriver(const std::map<std::string, Ears::Status>& statuses, DoctorFacts::Images& images) {
  const std::string folder = withoutSlash(folderOf(images.topic)) + "/";
  for (const auto& [name, status] : statuses) {
    if (status.values.count("frames published") == 0) continue;
    const std::string node = statusNode(name);
    const bool publishes =
        std::any_of(images.publishers.begin(), images.publishers.end(),
                    [&](const std::string& publisher) { return withoutSlash(publisher) == node; });
    if (!publishes && node.compare(0, folder.size(), folder) != 0) continue;
    const auto value = [&values = status.values](const std::string& key) {
      const auto found = values.find(key);
      return found == values.end() ? std::string() : found->second;
    };
    images.driver = true;
    images.driver_node = "/" + node;
    images.driver_state = value("state");
    images.driver_problem = value("last problem");
    images.device = textOr("/" + node + "/device", "");
    images.trigger = textOr("/" + node + "/trigger", "off");
    images.link = value("link");
    images.counts["published"] = status.growth("frames published");
    images.counts["lost"] = status.growth("frames lost");
    images.counts["incomplete"] = status.growth("frames incomplete");
    images.counts["underruns"] = status.growth("frames without memory");
    images.counts["missing packets"] = status.growth("packets missing");
    return;
  }
}

}  // namespace

bool answers(const std::string& uri, double seconds) {
  const std::size_t begin = uri.find("://");
  if (begin == std::string::npos) return false;
  const std::size_t colon = uri.find(':', begin + 3);
  if (colon == std::string::npos) return false;
  const std::string host = uri.substr(begin + 3, colon - begin - 3);
  const std::string port =
      uri.substr(colon + 1, uri.find_first_not_of("0123456789", colon + 1) - colon - 1);
  addrinfo hints{};
  hints.ai_socktype = SOCK_STREAM;
  addrinfo* list = nullptr;
  if (getaddrinfo(host.c_str(), port.c_str(), &hints, &list) != 0) return false;
  bool connected = false;
  for (const addrinfo* at = list; at != nullptr && !connected; at = at->ai_next) {
    const int handle = socket(at->ai_family, at->ai_socktype | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (handle < 0) continue;
    if (connect(handle, at->ai_addr, at->ai_addrlen) == 0) {
      connected = true;
    } else if (errno == EINPROGRESS) {
      pollfd wait{handle, POLLOUT, 0};
      int error = -1;
      socklen_t size = sizeof error;
      connected = poll(&wait, 1, static_cast<int>(1e3 * seconds)) == 1 &&
                  getsockopt(handle, SOL_SOCKET, SO_ERROR, &error, &size) == 0 && error == 0;
    }
    close(handle);
  }
  freeaddrinfo(list);
  return connected;
}

DoctorFacts machineFacts() {
  DoctorFacts facts;
  facts.cores = std::max(1u, std::thread::hardware_concurrency());
  double load = 0.0;
  if (getloadavg(&load, 1) == 1) facts.load = load;
  facts.socket_buffer = numberIn("/proc/sys/net/core/rmem_max");
  std::ifstream memory("/proc/meminfo");
  for (std::string line; std::getline(memory, line);) {
    const std::string key = "MemAvailable:";
    if (line.compare(0, key.size(), key) != 0) continue;
    const std::size_t digit = line.find_first_of("0123456789");
    if (digit == std::string::npos) break;
    const std::size_t end = line.find_first_not_of("0123456789", digit);
    if (const auto kib = parseNumber(line.substr(digit, end - digit)))
      facts.free_memory_mb = *kib / 1024.0;
  }
  return facts;
}

DoctorFacts gatherFacts(const DoctorOptions& options) {
  DoctorFacts facts = machineFacts();
  facts.master_uri = ros::master::getURI();
  ros::NodeHandle node;
  Graph graph;
  ros::param::param("/use_sim_time", facts.sim_time, false);
  facts.clock_published = !graph.publishers("/clock").empty();

  // The stereo node, by the topic that only it has.
  DoctorFacts::Stereo& stereo = facts.stereo;
  const std::string wanted = options.camera.empty() ? "" : node.resolveName(options.camera);
  for (const std::string& topic : graph.published("omnister/StageTimes")) {
    if (!wanted.empty() && folderOf(topic) != wanted) continue;
    stereo.ns = folderOf(topic);
    stereo.node = graph.publishers(topic).front();
    break;
  }
  if (stereo.node.empty()) stereo.ns = wanted.empty() ? "/camera" : wanted;
  stereo.answers = stereo.node.empty() || nodeAnswers(stereo.node);
  // A nodelet's parameters stand under its own name, which diagnostics carry; the usual one is
  // tried.
  std::string name = stereo.node;
  if (!name.empty() && !ros::param::has(name + "/mode") && !ros::param::has(name + "/max_range") &&
      ros::param::has(stereo.ns + "/stereo/max_range"))
    name = stereo.ns + "/stereo";
  stereo.rig = textOr(name + "/mode", "stage") == "rig";
  stereo.fixed_frame = textOr(name + "/fixed_frame", stereo.fixed_frame);
  stereo.min_baseline = parameterOr(name + "/min_baseline", stereo.min_baseline);
  stereo.max_baseline = parameterOr(name + "/max_baseline", stereo.max_baseline);
  stereo.max_skew = parameterOr(name + "/max_skew", stereo.max_skew);

  Ears ears(stereo.rig ? 2 : 1);
  std::vector<ros::Subscriber> subscribers;
  tf2_ros::Buffer tf;
  const TransformInput listener(tf);
  subscribers.push_back(node.subscribe("/diagnostics", 100, &Ears::onDiagnostics, &ears));
  const std::vector<std::string> stages = graph.published("omnister/StageState");
  if (!stages.empty()) {
    facts.stage.node = graph.publishers(stages.front()).front();
    facts.stage.ns = folderOf(stages.front());
    subscribers.push_back(node.subscribe(stages.front(), 100, &Ears::onStage, &ears));
  }
  facts.stage.published = !stages.empty() || !graph.published("sensor_msgs/JointState").empty();
  if (!options.passive && !stereo.node.empty()) {
    subscribers.push_back(node.subscribe<sensor_msgs::PointCloud2>(
        stereo.ns + "/points2", 1, [&ears](const sensor_msgs::PointCloud2::ConstPtr& cloud) {
          const std::lock_guard<std::mutex> lock(ears.mutex);
          ears.cloud = cloud;
          ++ears.clouds;
        }));
    // Now it subscribes to its images, and the master knows to which.
    ros::WallDuration(0.7).sleep();
    graph = Graph();
  }
  std::vector<std::string> topics = graph.subscribed(stereo.node, "sensor_msgs/Image");
  if (stereo.node.empty() || topics.size() != ears.images.size()) {
    topics.clear();
    for (const char* prefix : {"left/", "right/"})
      if (stereo.rig) topics.push_back(stereo.ns + "/" + prefix + "image_raw");
    if (topics.empty()) topics.push_back(stereo.ns + "/image_raw");
  }
  stereo.listened_to = !graph.subscribers(stereo.ns + "/points2").empty() ||
                       !graph.subscribers(stereo.ns + "/depth").empty() ||
                       !graph.subscribers(stereo.ns + "/range").empty();
  const std::vector<std::string> lens_topics = graph.subscribed(stereo.node, "omnister/LensModel");
  for (std::size_t i = 0; i < ears.images.size(); ++i) {
    DoctorFacts::Images images;
    images.topic = topics[i];
    images.publishers = graph.publishers(images.topic);
    images.publisher_answers = images.publishers.empty() || nodeAnswers(images.publishers.front());
    const std::string lens_topic = lens_topics.size() == ears.images.size()
                                       ? lens_topics[i]
                                       : folderOf(images.topic) + "/lens_model";
    images.lens_published = !graph.publishers(lens_topic).empty();
    subscribers.push_back(node.subscribe<LensModelMessage>(
        lens_topic, 16, [&ears, i](const LensModelMessage::ConstPtr& lens) {
          const std::lock_guard<std::mutex> lock(ears.mutex);
          if (!ears.lenses[i] || !(lens->header.stamp < ears.lenses[i]->header.stamp))
            ears.lenses[i] = lens;
        }));
    if (!options.passive)
      subscribers.push_back(node.subscribe<sensor_msgs::Image>(
          images.topic, 20,
          [&ears, i](const sensor_msgs::ImageConstPtr& image) { ears.onImage(i, image); }));
    facts.images.push_back(images);
  }

  const std::string status_name = withoutSlash(name) + ": stereo";
  const ros::SteadyTime start = ros::SteadyTime::now();
  for (;;) {
    ros::WallDuration(0.1).sleep();
    const double waited = (ros::SteadyTime::now() - start).toSec();
    if (waited >= options.seconds || !ros::ok()) break;
    if (options.interrupt && options.interrupt()) break;
    const std::lock_guard<std::mutex> lock(ears.mutex);
    // All is said when a cloud came and the diagnostics of the same time.
    const auto status = ears.statuses.find(status_name);
    if (ears.clouds > 0 && waited > 2.5 && status != ears.statuses.end() &&
        status->second.messages > 1)
      break;
  }
  for (ros::Subscriber& subscriber : subscribers) subscriber.shutdown();

  const std::lock_guard<std::mutex> lock(ears.mutex);
  stereo.clouds = ears.clouds;
  const auto found = ears.statuses.find(status_name);
  if (found != ears.statuses.end()) {
    const Ears::Status& status = found->second;
    stereo.summary = status.summary;
    double valid = 0.0, rejected = 0.0;
    for (const auto& [key, value] : status.last) {
      const auto after = [&key = key](const std::string& prefix) {
        return key.compare(0, prefix.size(), prefix) == 0 ? key.substr(prefix.size())
                                                          : std::string();
      };
      for (const char* prefix : {"frames, ", "dropped, "})
        if (const std::string what = after(prefix); !what.empty())
          stereo.counts[what] += status.growth(key);
      if (const std::string test = after("pixels rejected, "); !test.empty()) {
        stereo.rejected[test] = value;
        rejected += value;
      }
      if (key == "valid pixels") valid = value;
      if (key == "seconds, total") stereo.seconds = value;
      if (key == "baseline missed [m]") stereo.missed_baseline = value;
    }
    if (valid + rejected > 0.0) stereo.valid_fraction = valid / (valid + rejected);
    const auto calibration = ears.statuses.find(withoutSlash(name) + ": calibration");
    if (calibration != ears.statuses.end()) {
      const Ears::Status& drift = calibration->second;
      const auto verdict = drift.values.find("verdict");
      const auto px = drift.last.find("drift [px]");
      stereo.drift = verdict != drift.values.end() && verdict->second == "drift";
      if (px != drift.last.end()) stereo.drift_px = px->second;
    }
    if (options.passive) stereo.clouds = static_cast<int>(std::max(0.0, status.growth("clouds")));
  }
  for (std::size_t i = 0; i < facts.images.size(); ++i) {
    DoctorFacts::Images& images = facts.images[i];
    const Ears::Images& heard = ears.images[i];
    if (!options.passive) images.received = static_cast<int>(heard.stamps.size());
    if (heard.last) {
      judgeImage(heard.last, images);
      images.age = median(heard.ages);
      if (heard.stamps.size() > 1) {
        const double span = heard.stamps.back() - heard.stamps.front();
        if (span > 0.0) images.rate = static_cast<double>(heard.stamps.size() - 1) / span;
      }
    }
    // A lens from a file is no message: the node's own diagnostics tell of it.
    images.lens = ears.lenses[i] != nullptr;
    if (found != ears.statuses.end()) {
      const auto lens = found->second.values.find("lens of " + images.topic);
      if (lens != found->second.values.end()) images.lens = lens->second != "none";
    }
    std::string file = textOr(name + (i == 0 ? "/lens" : "/lens_displaced"), "");
    if (!file.empty()) {
      images.lens = images.lens_published = true;
      try {
        const LensFile lens = readLensFile(file);
        images.lens_width = lens.image_size.width;
        images.lens_height = lens.image_size.height;
      } catch (const Error&) {
        // The file may be on another machine.
      }
    } else if (ears.lenses[i]) {
      images.lens_width =
          static_cast<int>(std::min<std::uint32_t>(ears.lenses[i]->width, 1u << 20));
      images.lens_height =
          static_cast<int>(std::min<std::uint32_t>(ears.lenses[i]->height, 1u << 20));
    }
    if (!heard.last) images.lens_width = images.lens_height = 0;
    judgeDriver(ears.statuses, images);
    if (images.driver) networkFacts(images.link + " " + images.device, facts);
  }
  if (stereo.rig && !ears.images[0].stamps.empty() && !ears.images[1].stamps.empty()) {
    std::vector<double> apart;
    for (const double left : ears.images[0].stamps) {
      double least = std::abs(left - ears.images[1].stamps.front());
      for (const double right : ears.images[1].stamps)
        least = std::min(least, std::abs(left - right));
      apart.push_back(least);
    }
    facts.skew = median(apart);
  }
  if (!ears.stages.empty()) {
    const StageState& last = ears.stages.back();
    facts.stage.homed = last.homed != 0;
    facts.stage.moving = last.moving != 0;
    facts.stage.fault = last.fault;
    double least = last.position, most = last.position, moving = 0.0;
    for (const StageState& state : ears.stages) {
      least = std::min(least, state.position);
      most = std::max(most, state.position);
      moving += state.moving ? 1.0 : 0.0;
    }
    facts.stage.travel_seen = most - least;
    facts.stage.moving_share = moving / static_cast<double>(ears.stages.size());
  }
  // A stage node without its device says nothing but in its diagnostics.
  for (const auto& [status_of, status] : ears.statuses) {
    if ("/" + statusNode(status_of) != facts.stage.node || status.summary != "no stage") continue;
    const auto problem = status.values.find("last problem");
    facts.stage.fault =
        "no stage" + (problem == status.values.end() ? std::string() : ": " + problem->second);
  }
  if (!facts.stage.node.empty() && ros::param::has(facts.stage.node + "/max_m"))
    facts.stage.limits_apart = parameterOr(facts.stage.node + "/max_m", 0.3) -
                               parameterOr(facts.stage.node + "/min_m", 0.0);

  if (!stereo.rig && !facts.images.empty() && ears.images[0].last) {
    const std::string camera = facts.images.front().frame_id;
    std::vector<std::string> frames;
    tf._getFrameStrings(frames);
    const std::set<std::string> known(frames.begin(), frames.end());
    facts.tf.fixed_known = known.count(withoutSlash(stereo.fixed_frame)) > 0;
    facts.tf.camera_known = known.count(withoutSlash(camera)) > 0;
    try {
      const auto pose = tf.lookupTransform(stereo.fixed_frame, camera, ros::Time(0));
      if (!pose.header.stamp.isZero())
        facts.tf.age = (ros::Time::now() - pose.header.stamp).toSec();
    } catch (const std::exception&) {
      facts.tf.connected = false;
    }
  }
  return facts;
}

}  // namespace omnister
