// SPDX-License-Identifier: Apache-2.0
#include "omnister/device/aravis_camera.h"

#include <arpa/inet.h>
#include <arv.h>
#include <poll.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <condition_variable>
#include <cstring>
#include <deque>
#include <fstream>
#include <functional>
#include <mutex>
#include <set>
#include <thread>

#include "clock_mapping.h"
#include "omnister/common/numbers.h"
#include "pixel_format.h"

namespace omnister::device {
namespace {

using Steady = std::chrono::steady_clock;
using std::chrono::microseconds;
using std::chrono::milliseconds;
using std::chrono::nanoseconds;
using std::chrono::seconds;

constexpr std::size_t kMaxPayload = std::size_t{1} << 30;
constexpr int kLeastSocketBuffer = 2 << 20, kMostSocketBuffer = 64 << 20;
// On loopback packets are as large as the protocol allows.
constexpr int kLoopbackPacket = 16000;
// What the clocks of device and host drift apart in between is less than a millisecond.
constexpr seconds kLatchAgain(10), kTemperatureAgain(5), kExposureAgain(1), kPtpAgain(1);
constexpr int kLatches = 3;

struct Unref {
  void operator()(gpointer object) const { g_object_unref(object); }
};
template <typename T>
using Object = std::unique_ptr<T, Unref>;

/// What a call into Aravis complained of.
class Failure {
 public:
  Failure() = default;
  ~Failure() { g_clear_error(&error_); }
  Failure(const Failure&) = delete;
  Failure& operator=(const Failure&) = delete;
  GError** out() {
    g_clear_error(&error_);
    return &error_;
  }
  explicit operator bool() const { return error_ != nullptr; }
  bool is(int code) const {
    return error_ && error_->domain == ARV_DEVICE_ERROR && error_->code == code;
  }
  std::string text() const { return error_ ? printable(error_->message) : ""; }

 private:
  GError* error_ = nullptr;
};

std::string string(const char* text) { return text ? text : ""; }

std::string lower(std::string text) {
  std::transform(text.begin(), text.end(), text.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return text;
}

std::string describe(const AravisDevice& device) {
  const CameraIdentity& who = device.identity;
  return printable(who.vendor + " " + who.model + " " + who.serial +
                   (device.address.empty() ? "" : " at " + device.address));
}

std::string list(const std::vector<AravisDevice>& devices) {
  std::string text;
  for (const AravisDevice& device : devices) text += (text.empty() ? "" : ", ") + describe(device);
  return text;
}

/// Vendors have several spellings.
bool same(const CameraIdentity& a, const CameraIdentity& b) {
  return a.serial == b.serial && a.model == b.model;
}

std::optional<in_addr> parseAddress(const std::string& text) {
  in_addr address{};
  if (inet_pton(AF_INET, text.c_str(), &address) != 1) return std::nullopt;
  return address;
}

/// A UDP socket towards the control port of a camera.
class ControlSocket {
 public:
  explicit ControlSocket(in_addr address) : file_(socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0)) {
    sockaddr_in to{};
    to.sin_family = AF_INET;
    to.sin_port = htons(3956);
    to.sin_addr = address;
    if (file_ < 0 || connect(file_, reinterpret_cast<sockaddr*>(&to), sizeof to) != 0) {
      const int reason = errno;
      close();
      throw CameraError("no way to " + string(inet_ntoa(address)) + ": " + std::strerror(reason));
    }
  }
  ~ControlSocket() { close(); }
  ControlSocket(const ControlSocket&) = delete;
  ControlSocket& operator=(const ControlSocket&) = delete;

  /// Our own address on the way there.
  std::string interface() const {
    sockaddr_in own{};
    socklen_t size = sizeof own;
    if (getsockname(file_, reinterpret_cast<sockaddr*>(&own), &size) != 0) return "";
    std::array<char, INET_ADDRSTRLEN> text{};
    return string(inet_ntop(AF_INET, &own.sin_addr, text.data(), text.size()));
  }

  /// @return what came back within the time; 0: nothing
  std::size_t exchange(const std::uint8_t* request, std::size_t size, std::uint8_t* reply,
                       std::size_t capacity, milliseconds timeout) {
    if (send(file_, request, size, MSG_NOSIGNAL) < 0) return 0;
    pollfd waiting{file_, POLLIN, 0};
    if (poll(&waiting, 1, static_cast<int>(timeout.count())) <= 0) return 0;
    const ssize_t got = recv(file_, reply, capacity, 0);
    return got > 0 ? static_cast<std::size_t>(got) : 0;
  }

 private:
  void close() {
    if (file_ >= 0) ::close(file_);
    file_ = -1;
  }
  int file_;
};

/// Asks one address which camera stands there, by a GigE Vision discovery command.
std::optional<AravisDevice> probe(const std::string& text) {
  const std::optional<in_addr> address = parseAddress(text);
  if (!address) return std::nullopt;
  ControlSocket control(*address);
  // Key, flags (acknowledge), command DISCOVERY_CMD, length, id.
  constexpr std::array<std::uint8_t, 8> kDiscover = {0x42, 0x01, 0x00, 0x02, 0, 0, 0xff, 0xff};
  constexpr std::size_t kHeader = 8, kData = 248;
  std::array<std::uint8_t, 1024> reply{};
  for (int attempt = 0; attempt < 3; ++attempt) {
    const std::size_t size = control.exchange(kDiscover.data(), kDiscover.size(), reply.data(),
                                              reply.size(), milliseconds(300));
    if (size < kHeader + kData || reply[2] != 0x00 || reply[3] != 0x03) continue;
    const auto field = [&](std::size_t offset, std::size_t length) {
      const char* begin = reinterpret_cast<const char*>(reply.data()) + kHeader + offset;
      return std::string(begin, strnlen(begin, length));
    };
    AravisDevice device;
    device.address = text;
    device.protocol = "GigEVision";
    device.identity = {field(0x48, 32), field(0x68, 32), field(0xd8, 16)};
    device.id = device.identity.vendor + "-" + device.identity.model + "-" + device.identity.serial;
    return device;
  }
  return std::nullopt;
}

/// Dead devices are closed here: each of their objects takes seconds to give up.
class Closer {
 public:
  static Closer& instance() {
    static Closer closer;
    return closer;
  }
  void take(std::function<void()> close) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      waiting_.push_back(std::move(close));
      if (!thread_.joinable()) thread_ = std::thread(&Closer::run, this);
    }
    wake_.notify_all();
  }
  ~Closer() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      end_ = true;
    }
    wake_.notify_all();
    if (thread_.joinable()) thread_.join();
  }

 private:
  void run() {
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      wake_.wait(lock, [this] { return end_ || !waiting_.empty(); });
      if (waiting_.empty()) return;
      const std::function<void()> close = std::move(waiting_.front());
      waiting_.pop_front();
      lock.unlock();
      close();
      lock.lock();
    }
  }
  std::mutex mutex_;
  std::condition_variable wake_;
  std::deque<std::function<void()>> waiting_;
  bool end_ = false;
  std::thread thread_;
};

/// A feature that is a number, under all the names that Aravis knows for it.
struct NumberFeature {
  const char* name;
  const char* unit;
  gboolean (*available)(ArvCamera*, GError**);
  void (*bounds)(ArvCamera*, double*, double*, GError**);
  void (*set)(ArvCamera*, double, GError**);
  double (*get)(ArvCamera*, GError**);
};
constexpr NumberFeature kExposure = {"exposure time",
                                     " us",
                                     arv_camera_is_exposure_time_available,
                                     arv_camera_get_exposure_time_bounds,
                                     arv_camera_set_exposure_time,
                                     arv_camera_get_exposure_time};
constexpr NumberFeature kGain = {"gain",
                                 "",
                                 arv_camera_is_gain_available,
                                 arv_camera_get_gain_bounds,
                                 arv_camera_set_gain,
                                 arv_camera_get_gain};
constexpr NumberFeature kBlackLevel = {"black level",
                                       "",
                                       arv_camera_is_black_level_available,
                                       arv_camera_get_black_level_bounds,
                                       arv_camera_set_black_level,
                                       arv_camera_get_black_level};
constexpr NumberFeature kFrameRate = {"frame rate",
                                      " Hz",
                                      arv_camera_is_frame_rate_available,
                                      arv_camera_get_frame_rate_bounds,
                                      arv_camera_set_frame_rate,
                                      arv_camera_get_frame_rate};

struct AutoFeature {
  const char* name;
  gboolean (*available)(ArvCamera*, GError**);
  void (*set)(ArvCamera*, ArvAuto, GError**);
  ArvAuto (*get)(ArvCamera*, GError**);
};
constexpr AutoFeature kExposureAuto = {"automatic exposure", arv_camera_is_exposure_auto_available,
                                       arv_camera_set_exposure_time_auto,
                                       arv_camera_get_exposure_time_auto};
constexpr AutoFeature kGainAuto = {"automatic gain", arv_camera_is_gain_auto_available,
                                   arv_camera_set_gain_auto, arv_camera_get_gain_auto};

/// The kernel's limit of a socket's receive buffer.
long kernelSocketBuffer() {
  std::ifstream file("/proc/sys/net/core/rmem_max");
  long value = 0;
  return file >> value ? value : 0;
}

class AravisCamera : public Camera {
 public:
  AravisCamera(AravisDevice device, const CameraSettings& settings,
               std::vector<std::string> remarks)
      : device_(std::move(device)),
        settings_(settings),
        pool_(FramePool::make(static_cast<std::size_t>(settings.buffers) + 8)),
        remarks_(std::move(remarks)) {
    connect();
    try {
      applySettings();
    } catch (...) {
      close();
      throw;
    }
  }

  ~AravisCamera() override { close(); }

  CameraIdentity identity() const override { return device_.identity; }
  bool live() const override { return true; }
  void abandon() override { abandoned_ = true; }

  void start() override {
    requireAlive();
    readGeometry();
    Failure failure;
    const guint payload = arv_camera_get_payload(camera_.get(), failure.out());
    refuseIf(failure, "the size of its frames");
    if (payload == 0 || payload > kMaxPayload) {
      throw CameraError("the camera says that its frames have " + std::to_string(payload) +
                        " bytes");
    }
    payload_ = payload;
    stream_.reset(
        arv_camera_create_stream(camera_.get(), &AravisCamera::onStream, nullptr, failure.out()));
    refuseIf(failure, "no stream can be opened");
    if (ARV_IS_GV_STREAM(stream_.get())) tuneGigeStream();
    for (int i = 0; i < settings_.buffers; ++i) pushNewBuffer();
    readExposure();
    if (settings_.ptp || !clock_.offset()) measureClock();
    arv_camera_start_acquisition(camera_.get(), failure.out());
    refuseIf(failure, "it does not start");
    last_id_.reset();
  }

  void stop() override {
    if (!stream_) return;
    Failure failure;
    arv_camera_stop_acquisition(camera_.get(), failure.out());
    if (failure) details_.push_back("stopping: " + failure.text());
    past_ = totals();
    stream_.reset();
  }

  std::optional<Frame> grab(milliseconds timeout) override {
    const Steady::time_point until = Steady::now() + timeout;
    if (!stream_) return std::nullopt;
    while (true) {
      requireAlive();
      const auto left = std::chrono::duration_cast<microseconds>(until - Steady::now()).count();
      ArvBuffer* buffer = arv_stream_timeout_pop_buffer(
          stream_.get(), static_cast<guint64>(std::max<std::int64_t>(0, left)));
      if (!buffer) return std::nullopt;
      if (arv_buffer_get_status(buffer) == ARV_BUFFER_STATUS_SUCCESS) {
        if (std::optional<Frame> frame = toFrame(buffer)) return frame;
      } else {
        ++incomplete_;
        arv_stream_push_buffer(stream_.get(), buffer);
      }
      if (Steady::now() >= until) return std::nullopt;
    }
  }

  std::vector<std::string> takeRemarks() override { return std::exchange(remarks_, {}); }
  std::vector<std::string> takeDetails() override { return std::exchange(details_, {}); }

  CameraControls controls() override {
    CameraControls now;
    now.exposure_us = read(kExposure);
    now.gain = read(kGain);
    now.black_level = read(kBlackLevel);
    now.frame_rate_hz = read(kFrameRate);
    now.exposure_auto = read(kExposureAuto);
    now.gain_auto = read(kGainAuto);
    if (now.exposure_us) exposure_us_ = *now.exposure_us;
    return now;
  }

  CameraControls setControls(const CameraControls& wanted) override {
    requireAlive();
    if (wanted.frame_rate_hz) {
      // Aravis switches triggers off when it sets the frame rate.
      if (settings_.trigger == "off") {
        set(kFrameRate, *wanted.frame_rate_hz);
      } else {
        remarks_.push_back("a triggered camera has no frame rate");
      }
    }
    if (!wanted.exposure_auto.empty()) set(kExposureAuto, wanted.exposure_auto);
    if (wanted.exposure_us) set(kExposure, *wanted.exposure_us);
    if (!wanted.gain_auto.empty()) set(kGainAuto, wanted.gain_auto);
    if (wanted.gain) set(kGain, *wanted.gain);
    if (wanted.black_level) set(kBlackLevel, *wanted.black_level);
    return controls();
  }

  void trigger() override {
    requireAlive();
    Failure failure;
    arv_camera_software_trigger(camera_.get(), failure.out());
    refuseIf(failure, "no software trigger");
  }

  CameraStatistics statistics() override {
    CameraStatistics now = stream_ ? totals() : past_;
    now.incomplete = incomplete_;
    if (Steady::now() >= temperature_due_ && !lost_) {
      temperature_due_ = Steady::now() + kTemperatureAgain;
      temperature_ = number("DeviceTemperature");
    }
    now.temperature_c = temperature_;
    now.link = link_;
    return now;
  }

 private:
  void connect() {
    Failure failure;
    Object<ArvDevice> device;
    if (device_.protocol == "GigEVision") {
      const std::optional<in_addr> address = parseAddress(device_.address);
      if (!address) throw CameraError("the camera has no IP address");
      const std::string own = ControlSocket(*address).interface();
      // The local address that packets to the camera leave from: discovery may have seen it through
      // another interface, on which its stream would not arrive.
      const Object<GInetAddress> interface(g_inet_address_new_from_string(own.c_str()));
      const Object<GInetAddress> remote(g_inet_address_new_from_string(device_.address.c_str()));
      if (!interface || !remote) throw CameraError("no way to " + device_.address);
      local_ = own == device_.address || own.rfind("127.", 0) == 0;
      device.reset(arv_gv_device_new(interface.get(), remote.get(), failure.out()));
      if (device && !arv_gv_device_is_controller(ARV_GV_DEVICE(device.get()))) throwBusy();
    } else {
      device.reset(arv_open_device(device_.id.c_str(), failure.out()));
    }
    if (failure.is(ARV_DEVICE_ERROR_PROTOCOL_ERROR_ACCESS_DENIED) ||
        failure.is(ARV_DEVICE_ERROR_NOT_CONTROLLER) ||
        failure.is(ARV_DEVICE_ERROR_PROTOCOL_ERROR_BUSY)) {
      throwBusy();
    }
    if (failure || !device) throwCannotOpen(failure.text());
    camera_.reset(arv_camera_new_with_device(device.get(), failure.out()));
    if (failure || !camera_) throwCannotOpen(failure.text());
    g_signal_connect(device.get(), "control-lost", G_CALLBACK(&AravisCamera::onControlLost), this);
    link_ = device_.protocol + (device_.address.empty() ? "" : " " + device_.address);
  }

  [[noreturn]] void throwBusy() const {
    throw CameraError(describe(device_) + " is busy: another program controls it");
  }

  [[noreturn]] void throwCannotOpen(const std::string& why) const {
    std::string text =
        describe(device_) + " cannot be opened: " + (why.empty() ? "no reason given" : why);
    const std::string low = lower(why);
    if (device_.protocol == "USB3Vision" &&
        (low.find("access") != std::string::npos || low.find("permi") != std::string::npos)) {
      text +=
          "; a udev rule lets users open it: SUBSYSTEM==\"usb\", ATTRS{idVendor}==\"VVVV\", "
          "MODE=\"0660\", GROUP=\"plugdev\"";
    } else if (low.find("busy") != std::string::npos) {
      throwBusy();
    }
    throw CameraError(text);
  }

  static void onControlLost(ArvDevice* /*device*/, gpointer self) {
    static_cast<AravisCamera*>(self)->lost_ = true;
  }

  /// In the thread that takes packets from the kernel, which must not wait for others: what it
  /// misses is lost. Without the right to, it stays as it is.
  static void onStream(void* /*data*/, ArvStreamCallbackType type, ArvBuffer* /*buffer*/) {
    if (type != ARV_STREAM_CALLBACK_TYPE_INIT) return;
    constexpr int kAboveOthers = -10;
    setpriority(PRIO_PROCESS, static_cast<id_t>(syscall(SYS_gettid)), kAboveOthers);
  }

  void requireAlive() const {
    if (lost_) throw CameraError(describe(device_) + " no longer answers");
  }

  /// @throws CameraError for a failure of the connection, or of anything else
  void refuseIf(const Failure& failure, const std::string& what) {
    if (!failure) return;
    if (failure.is(ARV_DEVICE_ERROR_PROTOCOL_ERROR_ACCESS_DENIED) ||
        failure.is(ARV_DEVICE_ERROR_NOT_CONTROLLER)) {
      throwBusy();
    }
    throw CameraError(describe(device_) + ": " + what + ": " + failure.text());
  }

  /// A setting that did not work is told; a camera that does not answer is lost.
  bool tellIf(const Failure& failure, const std::string& what) {
    if (!failure) return false;
    if (failure.is(ARV_DEVICE_ERROR_TIMEOUT) || failure.is(ARV_DEVICE_ERROR_NOT_CONNECTED)) {
      throw CameraError(describe(device_) + " no longer answers");
    }
    remarks_.push_back(what + ": " + failure.text());
    return true;
  }

  void close() {
    auto device = camera_ ? arv_camera_get_device(camera_.get()) : nullptr;
    if (device) g_signal_handlers_disconnect_by_data(device, this);
    if (lost_ || abandoned_) {
      if (!camera_) return;
      // std::function wants what can be copied.
      const auto stream = std::make_shared<Object<ArvStream>>(std::move(stream_));
      const auto camera = std::make_shared<Object<ArvCamera>>(std::move(camera_));
      Closer::instance().take([stream, camera] {
        Failure ignored;
        if (*stream) arv_camera_stop_acquisition(camera->get(), ignored.out());
        stream->reset();
        camera->reset();
      });
      return;
    }
    stop();
    camera_.reset();
  }

  void set(const NumberFeature& feature, double wanted) {
    Failure failure;
    if (!feature.available(camera_.get(), failure.out())) {
      remarks_.push_back(std::string("this camera has no ") + feature.name);
      return;
    }
    double min = 0.0, max = 0.0;
    feature.bounds(camera_.get(), &min, &max, failure.out());
    double value = wanted;
    if (!failure && max > min) value = std::clamp(wanted, min, max);
    feature.set(camera_.get(), value, failure.out());
    if (tellIf(failure, feature.name)) return;
    const std::optional<double> taken = read(feature);
    if (taken && std::abs(*taken - wanted) > 0.01 * std::max(std::abs(wanted), 1e-3)) {
      remarks_.push_back(std::string(feature.name) + ": asked for " + formatNumber(wanted) +
                         ", the camera took " + formatNumber(*taken) + feature.unit);
    }
  }

  std::optional<double> read(const NumberFeature& feature) {
    Failure failure;
    if (!feature.available(camera_.get(), failure.out())) return std::nullopt;
    const double value = feature.get(camera_.get(), failure.out());
    if (failure || !std::isfinite(value)) return std::nullopt;
    return value;
  }

  void set(const AutoFeature& feature, const std::string& wanted) {
    Failure failure;
    if (!feature.available(camera_.get(), failure.out())) {
      if (wanted != "off") remarks_.push_back(std::string("this camera has no ") + feature.name);
      return;
    }
    const ArvAuto mode = wanted == "off"    ? ARV_AUTO_OFF
                         : wanted == "once" ? ARV_AUTO_ONCE
                                            : ARV_AUTO_CONTINUOUS;
    feature.set(camera_.get(), mode, failure.out());
    tellIf(failure, feature.name);
  }

  std::string read(const AutoFeature& feature) {
    Failure failure;
    if (!feature.available(camera_.get(), failure.out())) return "";
    const ArvAuto mode = feature.get(camera_.get(), failure.out());
    if (failure) return "";
    return mode == ARV_AUTO_OFF ? "off" : mode == ARV_AUTO_ONCE ? "once" : "continuous";
  }

  /// A number that a device may offer.
  std::optional<double> number(const char* feature) {
    Failure failure;
    if (!arv_camera_is_feature_available(camera_.get(), feature, failure.out()))
      return std::nullopt;
    const double value = arv_camera_get_float(camera_.get(), feature, failure.out());
    if (failure || !std::isfinite(value)) return std::nullopt;
    return value;
  }

  void applySettings() {
    Failure failure;
    // It may still be running for one who did not say goodbye.
    arv_camera_stop_acquisition(camera_.get(), failure.out());
    arv_camera_set_acquisition_mode(camera_.get(), ARV_ACQUISITION_MODE_CONTINUOUS, failure.out());
    if (failure) details_.push_back("AcquisitionMode: " + failure.text());
    for (const std::string& feature : settings_.features) {
      arv_device_set_features_from_string(arv_camera_get_device(camera_.get()), feature.c_str(),
                                          failure.out());
      tellIf(failure, "feature " + printable(feature));
    }
    choosePixelFormat();
    chooseRegion();
    if (settings_.frame_rate_hz > 0.0 && settings_.trigger == "off") {
      set(kFrameRate, settings_.frame_rate_hz);
    }
    chooseTrigger();
    if (!settings_.exposure_auto.empty()) set(kExposureAuto, settings_.exposure_auto);
    if (settings_.exposure_us) set(kExposure, *settings_.exposure_us);
    if (!settings_.gain_auto.empty()) set(kGainAuto, settings_.gain_auto);
    if (settings_.gain) set(kGain, *settings_.gain);
    if (settings_.black_level) set(kBlackLevel, *settings_.black_level);
    if (settings_.chunks) chooseChunks();
    if (settings_.ptp) choosePtp();
    if (device_.protocol == "GigEVision") tuneGige();
    readGeometry();
  }

  void choosePixelFormat() {
    Failure failure;
    guint count = 0;
    const std::unique_ptr<const char*, decltype(&g_free)> names(
        arv_camera_dup_available_pixel_formats_as_strings(camera_.get(), &count, failure.out()),
        &g_free);
    std::string offered;
    bool there = false;
    for (guint i = 0; names && i < count; ++i) {
      const std::string name = string(names.get()[i]);
      offered += (offered.empty() ? "" : ", ") + name;
      there = there || name == settings_.pixel_format;
    }
    if (!settings_.pixel_format.empty()) {
      if (!there) {
        throw CameraError(describe(device_) + " has no pixel format \"" +
                          printable(settings_.pixel_format) + "\"; it offers " + offered);
      }
      arv_camera_set_pixel_format_from_string(camera_.get(), settings_.pixel_format.c_str(),
                                              failure.out());
      refuseIf(failure, "pixel format");
    }
    const ArvPixelFormat code = arv_camera_get_pixel_format(camera_.get(), failure.out());
    refuseIf(failure, "pixel format");
    if (!findPixelFormat(code)) {
      throw CameraError(
          describe(device_) + " streams in " +
          string(arv_camera_get_pixel_format_as_string(camera_.get(), failure.out())) +
          ", for which there is no encoding; it offers " + offered);
    }
  }

  void chooseRegion() {
    Failure failure;
    if (settings_.binning.width > 0 && settings_.binning.height > 0) {
      if (arv_camera_is_binning_available(camera_.get(), failure.out())) {
        arv_camera_set_binning(camera_.get(), settings_.binning.width, settings_.binning.height,
                               failure.out());
        tellIf(failure, "binning");
      } else if (settings_.binning != cv::Size(1, 1)) {
        remarks_.emplace_back("this camera has no binning");
      }
    }
    const bool sized = settings_.size.width > 0 && settings_.size.height > 0;
    const bool placed = settings_.offset.x >= 0 && settings_.offset.y >= 0;
    if (!sized && !placed) return;
    int x = 0, y = 0, width = 0, height = 0;
    arv_camera_get_region(camera_.get(), &x, &y, &width, &height, failure.out());
    refuseIf(failure, "region");
    const cv::Size size = sized ? settings_.size : cv::Size(width, height);
    const cv::Point offset = placed ? settings_.offset : cv::Point(0, 0);
    arv_camera_set_region(camera_.get(), offset.x, offset.y, size.width, size.height,
                          failure.out());
    tellIf(failure, "region");
    arv_camera_get_region(camera_.get(), &x, &y, &width, &height, failure.out());
    refuseIf(failure, "region");
    if (cv::Size(width, height) != size || (placed && cv::Point(x, y) != offset)) {
      remarks_.push_back("region: asked for " + std::to_string(size.width) + "x" +
                         std::to_string(size.height) + " at (" + std::to_string(offset.x) + ", " +
                         std::to_string(offset.y) + "), the camera took " + std::to_string(width) +
                         "x" + std::to_string(height) + " at (" + std::to_string(x) + ", " +
                         std::to_string(y) + ")");
    }
  }

  void chooseTrigger() {
    Failure failure;
    if (settings_.trigger == "off") {
      arv_camera_clear_triggers(camera_.get(), failure.out());
      if (failure) details_.push_back("TriggerMode: " + failure.text());
      return;
    }
    guint count = 0;
    const std::unique_ptr<const char*, decltype(&g_free)> names(
        arv_camera_dup_available_trigger_sources(camera_.get(), &count, failure.out()), &g_free);
    std::string offered, source;
    for (guint i = 0; names && i < count; ++i) {
      const std::string name = string(names.get()[i]);
      offered += (offered.empty() ? "" : ", ") + name;
      if (lower(name) == lower(settings_.trigger)) source = name;
    }
    if (source.empty()) {
      throw CameraError(describe(device_) + " has no trigger \"" + printable(settings_.trigger) +
                        "\"; it offers " + (offered.empty() ? "none" : offered));
    }
    arv_camera_set_trigger(camera_.get(), source.c_str(), failure.out());
    refuseIf(failure, "trigger");
  }

  void chooseChunks() {
    Failure failure;
    if (!arv_camera_are_chunks_available(camera_.get(), failure.out())) {
      details_.emplace_back("this camera has no chunk data");
      return;
    }
    arv_camera_set_chunks(camera_.get(), "ExposureTime,Timestamp", failure.out());
    if (tellIf(failure, "chunk data")) return;
    chunks_.reset(arv_camera_create_chunk_parser(camera_.get()));
  }

  void choosePtp() {
    Failure failure;
    for (const char* feature : {"PtpEnable", "GevIEEE1588"}) {
      if (!arv_camera_is_feature_available(camera_.get(), feature, failure.out())) continue;
      arv_camera_set_boolean(camera_.get(), feature, TRUE, failure.out());
      if (tellIf(failure, feature)) continue;
      ptp_wanted_ = true;
      return;
    }
    remarks_.emplace_back("this camera has no PTP; its clock is mapped by arrival");
  }

  void tuneGige() {
    Failure failure;
    ArvCamera* camera = camera_.get();
    arv_camera_gv_set_packet_size_adjustment(camera, ARV_GV_PACKET_SIZE_ADJUSTMENT_NEVER);
    if (settings_.packet_size > 0) {
      arv_camera_gv_set_packet_size(camera, settings_.packet_size, failure.out());
    } else if (local_) {
      arv_camera_gv_set_packet_size(camera, kLoopbackPacket, failure.out());
    } else {
      arv_camera_gv_auto_packet_size(camera, failure.out());
    }
    tellIf(failure, "packet size");
    const guint size = arv_camera_gv_get_packet_size(camera, failure.out());
    if (!failure) link_ += ", packets of " + std::to_string(size) + " B";
    if (settings_.packet_delay_us > 0) {
      arv_camera_gv_set_packet_delay(camera, gint64{1000} * settings_.packet_delay_us,
                                     failure.out());
      tellIf(failure, "packet delay");
    }
    // What a packet socket listens to is the wire, and a camera of this host does not use it.
    arv_camera_gv_set_stream_options(
        camera, local_ ? ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED : ARV_GV_STREAM_OPTION_NONE);
  }

  void tuneGigeStream() {
    const long fitting =
        std::clamp<long>(4L * static_cast<long>(payload_), kLeastSocketBuffer, kMostSocketBuffer);
    const int bytes = settings_.socket_buffer_bytes > 0 ? settings_.socket_buffer_bytes
                                                        : static_cast<int>(fitting);
    g_object_set(stream_.get(), "socket-buffer", ARV_GV_STREAM_SOCKET_BUFFER_FIXED,
                 "socket-buffer-size", static_cast<gint>(bytes), "packet-resend",
                 settings_.packet_resend ? ARV_GV_STREAM_PACKET_RESEND_ALWAYS
                                         : ARV_GV_STREAM_PACKET_RESEND_NEVER,
                 nullptr);
    const long limit = kernelSocketBuffer();
    if (limit > 0 && limit < kLeastSocketBuffer && !told_limit_) {
      told_limit_ = true;
      remarks_.push_back("the kernel allows sockets " + std::to_string(limit) +
                         " bytes, packets may get lost: sysctl -w net.core.rmem_max=" +
                         std::to_string(std::max(bytes, kLeastSocketBuffer)));
    }
  }

  void readGeometry() {
    Failure failure;
    int x = 0, y = 0, width = 0, height = 0, dx = 1, dy = 1, sensor_width = 0, sensor_height = 0;
    arv_camera_get_region(camera_.get(), &x, &y, &width, &height, failure.out());
    if (failure) return;
    if (arv_camera_is_binning_available(camera_.get(), failure.out())) {
      arv_camera_get_binning(camera_.get(), &dx, &dy, failure.out());
      if (failure || dx < 1 || dy < 1) dx = dy = 1;
    }
    arv_camera_get_sensor_size(camera_.get(), &sensor_width, &sensor_height, failure.out());
    SensorRegion region;
    region.binning = {dx, dy};
    region.region = {x * dx, y * dy, width * dx, height * dy};
    region.sensor = {std::max(sensor_width, region.region.br().x),
                     std::max(sensor_height, region.region.br().y)};
    region_ = region;
  }

  void readExposure() {
    if (const std::optional<double> exposure = read(kExposure)) exposure_us_ = *exposure;
    exposure_changes_ = !read(kExposureAuto).empty() && read(kExposureAuto) != "off";
    exposure_due_ = Steady::now() + kExposureAgain;
  }

  /// The device's clock against ours, asked for on the wire.
  void measureClock() {
    latch_due_ = Steady::now() + kLatchAgain;
    if (latch_works_ && !*latch_works_) return;
    const struct {
      const char* command;
      const char* value;
    } names[] = {{"TimestampLatch", "TimestampLatchValue"},
                 {"GevTimestampControlLatch", "GevTimestampValue"}};
    Failure failure;
    for (const auto& name : names) {
      if (!arv_camera_is_feature_available(camera_.get(), name.command, failure.out()) ||
          !arv_camera_is_feature_available(camera_.get(), name.value, failure.out())) {
        continue;
      }
      nanoseconds least = seconds(1);
      std::optional<std::int64_t> offset;
      for (int i = 0; i < kLatches; ++i) {
        const Stamp before = now();
        arv_camera_execute_command(camera_.get(), name.command, failure.out());
        const Stamp after = now();
        if (failure) break;
        // The latched value may stand there a little later.
        gint64 ticks = latched_;
        for (int wait = 0; wait < 10 && ticks == latched_; ++wait) {
          ticks = arv_camera_get_integer(camera_.get(), name.value, failure.out());
          if (failure) break;
          if (ticks == latched_) std::this_thread::sleep_for(milliseconds(1));
        }
        if (failure || ticks == latched_) break;
        latched_ = ticks;
        if (after - before >= least) continue;
        least = after - before;
        offset = (before + (after - before) / 2).time_since_epoch().count() - toNanoseconds(ticks);
      }
      if (offset) {
        latch_works_ = true;
        latch_offset_ = offset;
        return;
      }
    }
    if (!latch_works_) {
      latch_works_ = false;
      details_.emplace_back("the camera's clock cannot be read, it is mapped by arrival");
    }
  }

  std::int64_t toNanoseconds(gint64 ticks) {
    if (ARV_IS_GV_DEVICE(arv_camera_get_device(camera_.get()))) {
      Failure failure;
      const guint64 frequency = arv_gv_device_get_timestamp_tick_frequency(
          ARV_GV_DEVICE(arv_camera_get_device(camera_.get())), failure.out());
      if (!failure && frequency > 0 && frequency != 1000000000u) {
        return static_cast<std::int64_t>(static_cast<long double>(ticks) * 1e9L /
                                         static_cast<long double>(frequency));
      }
    }
    return ticks;
  }

  void watchPtp() {
    if (!ptp_wanted_ || Steady::now() < ptp_due_) return;
    ptp_due_ = Steady::now() + kPtpAgain;
    Failure failure;
    for (const char* feature : {"PtpStatus", "GevIEEE1588Status"}) {
      if (!arv_camera_is_feature_available(camera_.get(), feature, failure.out())) continue;
      const std::string status =
          lower(string(arv_camera_get_string(camera_.get(), feature, failure.out())));
      const bool locked = !failure && (status == "slave" || status == "master");
      if (locked != ptp_locked_) {
        details_.push_back("PTP: " + status);
        clock_ = ClockMapping();
      }
      ptp_locked_ = locked;
      return;
    }
  }

  Stamp stampOf(ArvBuffer* buffer) {
    if (exposure_changes_ && Steady::now() >= exposure_due_) readExposure();
    if (latch_works_.value_or(false) && Steady::now() >= latch_due_) measureClock();
    watchPtp();
    double exposure_us = exposure_us_;
    if (chunks_) {
      Failure failure;
      const double value = arv_chunk_parser_get_float_value(chunks_.get(), buffer,
                                                            "ChunkExposureTime", failure.out());
      if (!failure && value > 0.0) exposure_us = value;
    }
    const nanoseconds exposure(std::llround(exposure_us * 1e3));
    const nanoseconds extra(std::llround(settings_.stamp_offset_us * 1e3));
    const Stamp arrival{
        nanoseconds(static_cast<std::int64_t>(arv_buffer_get_system_timestamp(buffer)))};
    const auto device = static_cast<std::int64_t>(arv_buffer_get_timestamp(buffer));
    if (device == 0) return arrival - exposure / 2 + extra;
    const std::int64_t start = settings_.stamp_is_exposure_end ? device - exposure.count() : device;
    // The first packet leaves after the end of the exposure.
    clock_.observe(start + exposure.count(), arrival);
    std::int64_t offset = *clock_.offset();
    if (ptp_locked_) {
      // Both clocks are synchronous, but may count leap seconds differently.
      constexpr std::int64_t kSecond = 1000000000, kSlack = 50000000;
      std::int64_t whole = (offset + kSlack) / kSecond;
      if ((offset + kSlack) % kSecond < 0) --whole;
      offset = whole * kSecond;
    } else if (latch_works_.value_or(false) && latch_offset_) {
      offset = *latch_offset_;
    }
    return Stamp(nanoseconds(start + offset)) + exposure / 2 + extra;
  }

  /// Frame numbers of 16 bits go from 65535 to 1.
  std::uint64_t sequenceOf(guint64 id) {
    if (last_id_) {
      constexpr guint64 kWrap = 65535;
      guint64 step = id - *last_id_;
      if (id < *last_id_) step = *last_id_ <= kWrap ? id + kWrap - *last_id_ : 1;
      sequence_ += std::max<guint64>(step, 1);
    } else {
      ++sequence_;
    }
    last_id_ = id;
    return sequence_;
  }

  void pushNewBuffer() {
    auto* memory = new FrameMemoryPtr(pool_->take(payload_));
    arv_stream_push_buffer(
        stream_.get(),
        arv_buffer_new_full(payload_, (*memory)->bytes.data(), memory,
                            [](gpointer p) { delete static_cast<FrameMemoryPtr*>(p); }));
  }

  /// Takes the buffer; one like it goes back into the stream.
  std::optional<Frame> toFrame(ArvBuffer* buffer) {
    const auto payload_type = arv_buffer_get_payload_type(buffer);
    const bool image = payload_type == ARV_BUFFER_PAYLOAD_TYPE_IMAGE ||
                       payload_type == ARV_BUFFER_PAYLOAD_TYPE_EXTENDED_CHUNK_DATA ||
                       payload_type == ARV_BUFFER_PAYLOAD_TYPE_MULTIPART;
    std::size_t bytes = 0;
    const auto* data =
        image ? static_cast<const std::uint8_t*>(arv_buffer_get_image_data(buffer, &bytes))
              : nullptr;
    const PixelFormat* format =
        data ? findPixelFormat(arv_buffer_get_image_pixel_format(buffer)) : nullptr;
    const cv::Size size =
        data ? cv::Size(arv_buffer_get_image_width(buffer), arv_buffer_get_image_height(buffer))
             : cv::Size();
    int pad = 0, ignored = 0;
    if (data) arv_buffer_get_image_padding(buffer, &pad, &ignored);
    const std::size_t step = format ? (static_cast<std::size_t>(size.width) *
                                           static_cast<std::size_t>(format->bitsPerPixel()) +
                                       7) / 8 +
                                          static_cast<std::size_t>(std::max(pad, 0))
                                    : 0;
    if (!format || size.width <= 0 || size.height <= 0 ||
        step * static_cast<std::size_t>(size.height) > bytes) {
      ++incomplete_;
      if (!told_format_) {
        told_format_ = true;
        remarks_.emplace_back("frames of a kind that is not known are left out");
      }
      arv_stream_push_buffer(stream_.get(), buffer);
      return std::nullopt;
    }
    Frame frame;
    frame.encoding = format->encoding;
    frame.stamp = stampOf(buffer);
    frame.sequence = sequenceOf(arv_buffer_get_frame_id(buffer));
    frame.region = region_;
    const auto* memory = static_cast<const FrameMemoryPtr*>(arv_buffer_get_user_data(buffer));
    if (format->direct() && memory && (*memory)->bytes.data() == data) {
      frame.memory = *memory;
      frame.image = cv::Mat(size, format->type, frame.memory->bytes.data(), step);
      pushNewBuffer();
      g_object_unref(buffer);
    } else {
      frame.image = unpack(*format, data, size, step);
      arv_stream_push_buffer(stream_.get(), buffer);
    }
    return frame;
  }

  /// Of all streams since the device was opened.
  CameraStatistics totals() {
    CameraStatistics all = past_;
    guint64 complete = 0, failures = 0, underruns = 0;
    arv_stream_get_statistics(stream_.get(), &complete, &failures, &underruns);
    all.complete += complete;
    all.underruns += underruns;
    if (ARV_IS_GV_STREAM(stream_.get())) {
      all.resent_packets += arv_stream_get_info_uint64_by_name(stream_.get(), "n_resent_packets");
      all.missing_packets += arv_stream_get_info_uint64_by_name(stream_.get(), "n_missing_packets");
    }
    return all;
  }

  AravisDevice device_;
  const CameraSettings settings_;
  const std::shared_ptr<FramePool> pool_;
  std::vector<std::string> remarks_, details_;
  Object<ArvCamera> camera_;
  Object<ArvStream> stream_;
  Object<ArvChunkParser> chunks_;
  std::atomic<bool> lost_{false};
  bool abandoned_ = false;
  bool local_ = false;
  bool told_limit_ = false, told_format_ = false;
  std::string link_;
  std::size_t payload_ = 0;
  std::optional<SensorRegion> region_;
  double exposure_us_ = 0.0;
  bool exposure_changes_ = false;
  Steady::time_point exposure_due_, latch_due_, temperature_due_, ptp_due_;
  ClockMapping clock_;
  std::optional<bool> latch_works_;
  std::optional<std::int64_t> latch_offset_;
  gint64 latched_ = 0;
  bool ptp_wanted_ = false, ptp_locked_ = false;
  std::optional<guint64> last_id_;
  std::uint64_t sequence_ = 0;
  std::uint64_t incomplete_ = 0;
  CameraStatistics past_;
  std::optional<double> temperature_;
};

}  // namespace

std::vector<AravisDevice> listAravisDevices() {
  // Aravis keeps one list for the whole program.
  static std::mutex mutex;
  const std::lock_guard<std::mutex> lock(mutex);
  arv_update_device_list();
  std::vector<AravisDevice> devices;
  for (unsigned i = 0; i < arv_get_n_devices(); ++i) {
    AravisDevice device;
    device.id = string(arv_get_device_id(i));
    device.physical = string(arv_get_device_physical_id(i));
    device.protocol = string(arv_get_device_protocol(i));
    if (device.protocol == "GigEVision") device.address = string(arv_get_device_address(i));
    device.identity = {string(arv_get_device_vendor(i)), string(arv_get_device_model(i)),
                       string(arv_get_device_serial_nbr(i))};
    const bool seen = std::any_of(devices.begin(), devices.end(), [&](const AravisDevice& other) {
      return other.protocol == device.protocol && other.address == device.address &&
             same(other.identity, device.identity);
    });
    if (!seen) devices.push_back(std::move(device));
  }
  return devices;
}

std::vector<AravisDevice> matchAravisDevices(const std::vector<AravisDevice>& devices,
                                             const std::string& which) {
  const std::string wanted = lower(which);
  using Name = std::string (*)(const AravisDevice&);
  static constexpr Name kNames[] = {
      [](const AravisDevice& d) { return d.identity.serial; },
      [](const AravisDevice& d) { return d.address; },
      [](const AravisDevice& d) { return d.physical; },
      [](const AravisDevice& d) { return d.id; },
      [](const AravisDevice& d) {
        return d.identity.vendor + "-" + d.identity.model + "-" + d.identity.serial;
      },
      [](const AravisDevice& d) { return d.identity.vendor + "-" + d.identity.serial; },
      [](const AravisDevice& d) { return d.identity.vendor + "-" + d.identity.model; },
      [](const AravisDevice& d) { return d.identity.model; },
  };
  std::vector<AravisDevice> found;
  for (const Name name : kNames) {
    std::copy_if(devices.begin(), devices.end(), std::back_inserter(found),
                 [&](const AravisDevice& device) {
                   return wanted.empty() || lower(name(device)) == wanted;
                 });
    if (!found.empty()) break;
  }
  std::sort(found.begin(), found.end(), [](const AravisDevice& a, const AravisDevice& b) {
    return std::tie(a.identity.serial, a.address) < std::tie(b.identity.serial, b.address);
  });
  return found;
}

std::unique_ptr<Camera> openAravisCamera(const std::string& which, const CameraSettings& settings) {
  std::vector<std::string> remarks;
  std::optional<AravisDevice> device = probe(which);
  if (device && settings.identity && !same(device->identity, *settings.identity)) device.reset();
  if (!device) {
    const std::vector<AravisDevice> all = listAravisDevices();
    std::vector<AravisDevice> found;
    if (settings.identity) {
      std::copy_if(all.begin(), all.end(), std::back_inserter(found),
                   [&](const AravisDevice& d) { return same(d.identity, *settings.identity); });
    } else {
      found = matchAravisDevices(all, which);
    }
    if (found.empty()) {
      const std::string wanted = settings.identity
                                     ? settings.identity->vendor + " " + settings.identity->model +
                                           " " + settings.identity->serial
                                 : which.empty() ? "no camera"
                                                 : "no camera \"" + which + "\"";
      throw CameraError(
          printable(settings.identity ? wanted + " does not answer" : wanted + " is there") +
          (all.empty() ? "; none is found" : "; there are: " + list(all)));
    }
    device = found.front();
    if (!device->address.empty()) {
      // Aravis remembers cameras that are gone, and another may stand there now.
      const std::optional<AravisDevice> there = probe(device->address);
      if (!there || !same(there->identity, device->identity)) {
        throw CameraError(describe(*device) + " does not answer" +
                          (there ? "; there stands " + describe(*there) : ""));
      }
    }
    if (which.empty()) {
      remarks.push_back("the device names no camera, taking " + describe(*device) + " of " +
                        std::to_string(found.size()) +
                        "; aravis:" + printable(device->identity.serial) + " would be sure");
    }
    const bool several = std::any_of(found.begin(), found.end(), [&](const AravisDevice& d) {
      return !same(d.identity, device->identity);
    });
    if (several) {
      remarks.push_back("\"" + printable(which) + "\" fits several cameras, taking " +
                        describe(*device) + "; there are: " + list(found));
    }
  }
  return std::make_unique<AravisCamera>(*device, settings, std::move(remarks));
}

}  // namespace omnister::device
