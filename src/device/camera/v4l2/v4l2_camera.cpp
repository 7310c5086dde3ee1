// SPDX-License-Identifier: Apache-2.0
#include "device/camera/v4l2/v4l2_camera.h"

#include <fcntl.h>
#include <linux/videodev2.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <tuple>

#include "device/camera/v4l2/v4l2_format.h"
#include "omnister/common/numbers.h"

namespace omnister::device {
namespace {

namespace fs = std::filesystem;
using Steady = std::chrono::steady_clock;
using std::chrono::milliseconds;
using std::chrono::nanoseconds;

constexpr std::size_t kMaxImageBytes = std::size_t{1} << 30;
constexpr auto kCapture = V4L2_BUF_TYPE_VIDEO_CAPTURE;

std::string fourccText(std::uint32_t code) {
  std::string text;
  for (int i = 0; i < 4; ++i) text += static_cast<char>(code >> (8 * i) & 0x7f);
  while (!text.empty() && text.back() == ' ') text.pop_back();
  return printable(text);
}

std::optional<std::uint32_t> parseFourcc(std::string text) {
  if (text.empty() || text.size() > 4) return std::nullopt;
  text.resize(4, ' ');
  std::uint32_t code = 0;
  for (int i = 0; i < 4; ++i) {
    code |=
        static_cast<std::uint32_t>(static_cast<unsigned char>(text[static_cast<std::size_t>(i)]))
        << (8 * i);
  }
  return code;
}

/// Again where a signal came in between.
template <typename Argument>
int control(int file, unsigned long request, Argument* argument) {
  int result = 0;
  do {
    result = ioctl(file, request, argument);
  } while (result != 0 && errno == EINTR);
  return result;
}

template <std::size_t N>
std::string text(const std::uint8_t (&field)[N]) {
  const char* begin = reinterpret_cast<const char*>(field);
  return printable(std::string(begin, strnlen(begin, N)));
}

/// "Exposure Time, Absolute" is exposure_time_absolute.
std::string controlName(const std::string& name) {
  std::string out;
  for (const char c : name) {
    const auto byte = static_cast<unsigned char>(c);
    if (std::isalnum(byte) != 0) {
      out += static_cast<char>(std::tolower(byte));
    } else if (!out.empty() && out.back() != '_') {
      out += '_';
    }
  }
  while (!out.empty() && out.back() == '_') out.pop_back();
  return out;
}

class File {
 public:
  explicit File(const std::string& path)
      : file_(open(path.c_str(), O_RDWR | O_NONBLOCK | O_CLOEXEC)) {}
  ~File() {
    if (file_ >= 0) close(file_);
  }
  File(File&& other) noexcept : file_(std::exchange(other.file_, -1)) {}
  File& operator=(File&&) = delete;
  explicit operator bool() const { return file_ >= 0; }
  int get() const { return file_; }

 private:
  int file_;
};

/// The serial number that the bus tells, where there is one.
std::string serialOf(const std::string& path) {
  std::error_code error;
  const fs::path real = fs::canonical(path, error);
  if (error) return "";
  fs::path device =
      fs::canonical(fs::path("/sys/class/video4linux") / real.filename() / "device", error);
  for (int level = 0; level < 3 && !error && device.has_relative_path(); ++level) {
    std::ifstream file(device / "serial");
    std::string serial;
    if (file >> serial && !serial.empty()) return printable(serial);
    device = device.parent_path();
  }
  return "";
}

/// @return nullopt for what is no camera
std::optional<V4l2Device> identify(int file, const std::string& path) {
  v4l2_capability capability{};
  if (control(file, VIDIOC_QUERYCAP, &capability) != 0) return std::nullopt;
  const std::uint32_t able = (capability.capabilities & V4L2_CAP_DEVICE_CAPS) != 0
                                 ? capability.device_caps
                                 : capability.capabilities;
  if ((able & V4L2_CAP_VIDEO_CAPTURE) == 0 || (able & V4L2_CAP_STREAMING) == 0) return std::nullopt;
  V4l2Device device;
  device.path = path;
  device.bus = text(capability.bus_info);
  device.identity = {text(capability.driver), text(capability.card), serialOf(path)};
  if (device.identity.serial.empty()) device.identity.serial = device.bus;
  return device;
}

bool same(const CameraIdentity& a, const CameraIdentity& b) {
  return a.serial == b.serial && a.model == b.model && a.vendor == b.vendor;
}

std::string list(const std::vector<V4l2Device>& devices) {
  std::string out;
  for (const V4l2Device& d : devices) {
    out += (out.empty() ? "" : ", ") + d.path + " (" + d.identity.model + ", " + d.bus + ")";
  }
  return out;
}

[[noreturn]] void throwCannotOpen(const std::string& path, int reason) {
  const std::string shown = printable(path);
  if (reason == EACCES || reason == EPERM) {
    throw CameraError("no permission to open " + shown +
                      ": its users are those of the group video (usermod -aG video NAME, then log "
                      "in again)");
  }
  if (reason == EBUSY) throw CameraError(shown + " is busy: another program controls it");
  throw CameraError(shown + " cannot be opened: " + std::strerror(reason));
}

/// Memory that driver and program share.
class Mapping {
 public:
  Mapping(int file, std::size_t length, std::int64_t offset)
      : data_(mmap(nullptr, length, PROT_READ | PROT_WRITE, MAP_SHARED, file, offset)),
        length_(length) {
    if (data_ == MAP_FAILED)
      throw CameraError(std::string("mapping a frame: ") + std::strerror(errno));
  }
  ~Mapping() {
    if (data_ != MAP_FAILED) munmap(data_, length_);
  }
  Mapping(Mapping&& other) noexcept
      : data_(std::exchange(other.data_, MAP_FAILED)), length_(other.length_) {}
  Mapping& operator=(Mapping&&) = delete;
  const std::uint8_t* data() const { return static_cast<const std::uint8_t*>(data_); }
  std::size_t length() const { return length_; }

 private:
  void* data_;
  std::size_t length_;
};

class V4l2Camera : public Camera {
 public:
  V4l2Camera(File file, V4l2Device device, const CameraSettings& settings,
             std::vector<std::string> remarks)
      : file_(std::move(file)),
        device_(std::move(device)),
        settings_(settings),
        pool_(FramePool::make(static_cast<std::size_t>(settings.buffers) + 8)),
        remarks_(std::move(remarks)) {
    if (settings_.trigger != "off") {
      throw CameraError(device_.path + " has no trigger, expected trigger: off");
    }
    if (settings_.offset.x > 0 || settings_.offset.y > 0 || settings_.binning.width > 1 ||
        settings_.binning.height > 1) {
      remarks_.emplace_back("offset and binning are not for V4L2 cameras");
    }
    chooseFormat();
    if (settings_.frame_rate_hz > 0.0) setFrameRate(settings_.frame_rate_hz);
    for (const std::string& feature : settings_.features) setByName(feature);
    CameraControls wanted;
    wanted.exposure_us = settings_.exposure_us;
    wanted.exposure_auto = settings_.exposure_auto;
    wanted.gain = settings_.gain;
    wanted.gain_auto = settings_.gain_auto;
    wanted.black_level = settings_.black_level;
    apply(wanted);
    controls();
  }

  ~V4l2Camera() override { release(); }

  CameraIdentity identity() const override { return device_.identity; }
  bool live() const override { return true; }

  void start() override {
    v4l2_requestbuffers request{};
    request.count = static_cast<std::uint32_t>(settings_.buffers);
    request.type = kCapture;
    request.memory = V4L2_MEMORY_MMAP;
    require(control(file_.get(), VIDIOC_REQBUFS, &request), "memory for frames");
    if (request.count < 2) throw CameraError(device_.path + " has no memory for frames");
    for (std::uint32_t i = 0; i < request.count; ++i) {
      v4l2_buffer buffer = emptyBuffer(i);
      require(control(file_.get(), VIDIOC_QUERYBUF, &buffer), "memory for frames");
      if (buffer.length > kMaxImageBytes) throw CameraError(device_.path + ": frames too large");
      mappings_.emplace_back(file_.get(), buffer.length, buffer.m.offset);
      require(control(file_.get(), VIDIOC_QBUF, &buffer), "memory for frames");
    }
    int type = kCapture;
    require(control(file_.get(), VIDIOC_STREAMON, &type), "it does not start");
    last_number_.reset();
  }

  void stop() override { release(); }

  std::optional<Frame> grab(milliseconds timeout) override {
    const Steady::time_point until = Steady::now() + timeout;
    if (mappings_.empty()) return std::nullopt;
    while (true) {
      const auto left = std::chrono::duration_cast<milliseconds>(until - Steady::now()).count();
      pollfd waiting{file_.get(), POLLIN, 0};
      const int ready = poll(&waiting, 1, static_cast<int>(std::max<std::int64_t>(0, left)));
      if (ready < 0 && errno != EINTR) fail("waiting");
      if (ready > 0) {
        v4l2_buffer buffer = emptyBuffer(0);
        if (control(file_.get(), VIDIOC_DQBUF, &buffer) == 0) {
          std::optional<Frame> frame = take(buffer);
          v4l2_buffer again = emptyBuffer(buffer.index);
          require(control(file_.get(), VIDIOC_QBUF, &again), "memory for frames");
          if (frame) return frame;
        } else if (errno == EIO) {
          ++statistics_.incomplete;
        } else if (errno != EAGAIN) {
          fail("no frame");
        } else if ((waiting.revents & (POLLERR | POLLHUP)) != 0) {
          throw CameraError(device_.path + " was unplugged, or stopped by itself");
        }
      }
      if (Steady::now() >= until) return std::nullopt;
    }
  }

  std::vector<std::string> takeRemarks() override { return std::exchange(remarks_, {}); }
  std::vector<std::string> takeDetails() override { return std::exchange(details_, {}); }

  CameraControls controls() override {
    CameraControls now;
    if (const auto value = get(V4L2_CID_EXPOSURE_ABSOLUTE)) now.exposure_us = 100.0 * *value;
    if (const auto value = get(V4L2_CID_GAIN)) now.gain = *value;
    if (const auto value = get(V4L2_CID_EXPOSURE_AUTO)) {
      now.exposure_auto = *value == V4L2_EXPOSURE_MANUAL ? "off" : "continuous";
    }
    if (const auto value = get(V4L2_CID_AUTOGAIN))
      now.gain_auto = *value != 0 ? "continuous" : "off";
    v4l2_streamparm parameters{};
    parameters.type = kCapture;
    if (control(file_.get(), VIDIOC_G_PARM, &parameters) == 0) {
      const v4l2_fract& time = parameters.parm.capture.timeperframe;
      if (time.numerator > 0 && time.denominator > 0) {
        now.frame_rate_hz = static_cast<double>(time.denominator) / time.numerator;
      }
    }
    exposure_us_ = now.exposure_us.value_or(0.0);
    return now;
  }

  CameraControls setControls(const CameraControls& wanted) override {
    if (wanted.frame_rate_hz) {
      // Drivers refuse it while they stream.
      const bool streaming = !mappings_.empty();
      if (streaming) release();
      setFrameRate(*wanted.frame_rate_hz);
      if (streaming) start();
    }
    apply(wanted);
    return controls();
  }

  CameraStatistics statistics() override {
    CameraStatistics now = statistics_;
    now.link = device_.path + " (" + device_.bus + "), " + fourccText(given_.pixelformat) + " " +
               std::to_string(given_.width) + "x" + std::to_string(given_.height);
    return now;
  }

 private:
  static v4l2_buffer emptyBuffer(std::uint32_t index) {
    v4l2_buffer buffer{};
    buffer.type = kCapture;
    buffer.memory = V4L2_MEMORY_MMAP;
    buffer.index = index;
    return buffer;
  }

  [[noreturn]] void fail(const std::string& what) const {
    const int reason = errno;
    if (reason == ENODEV || reason == ENXIO) throw CameraError(device_.path + " was unplugged");
    if (reason == EBUSY) throwCannotOpen(device_.path, EBUSY);
    throw CameraError(device_.path + ": " + what + ": " + std::strerror(reason));
  }
  void require(int result, const std::string& what) const {
    if (result != 0) fail(what);
  }

  void release() {
    int type = kCapture;
    control(file_.get(), VIDIOC_STREAMOFF, &type);
    mappings_.clear();
    v4l2_requestbuffers none{};
    none.type = kCapture;
    none.memory = V4L2_MEMORY_MMAP;
    control(file_.get(), VIDIOC_REQBUFS, &none);
  }

  void chooseFormat() {
    std::vector<std::uint32_t> offered;
    std::string names;
    v4l2_fmtdesc description{};
    description.type = kCapture;
    for (; offered.size() < 256 && control(file_.get(), VIDIOC_ENUM_FMT, &description) == 0;
         ++description.index) {
      offered.push_back(description.pixelformat);
      names += (names.empty() ? "" : ", ") + fourccText(description.pixelformat);
    }
    const auto offers = [&](std::uint32_t code) {
      return std::find(offered.begin(), offered.end(), code) != offered.end();
    };
    v4l2_format format{};
    format.type = kCapture;
    require(control(file_.get(), VIDIOC_G_FMT, &format), "format");
    v4l2_pix_format& pixels = format.fmt.pix;
    if (!settings_.pixel_format.empty()) {
      const std::optional<std::uint32_t> code = parseFourcc(settings_.pixel_format);
      if (!code || !offers(*code)) {
        throw CameraError(device_.path + " has no pixel format \"" +
                          printable(settings_.pixel_format) + "\"; it offers " + names);
      }
      pixels.pixelformat = *code;
    } else if (!findV4l2Format(pixels.pixelformat)) {
      const auto known = std::find_if(offered.begin(), offered.end(),
                                      [](std::uint32_t code) { return findV4l2Format(code); });
      if (known != offered.end()) pixels.pixelformat = *known;
    }
    const std::uint32_t wanted = pixels.pixelformat;
    if (settings_.size.width > 0 && settings_.size.height > 0) {
      pixels.width = static_cast<std::uint32_t>(settings_.size.width);
      pixels.height = static_cast<std::uint32_t>(settings_.size.height);
    }
    const cv::Size size(static_cast<int>(pixels.width), static_cast<int>(pixels.height));
    pixels.field = V4L2_FIELD_NONE;
    pixels.bytesperline = 0;
    pixels.sizeimage = 0;
    require(control(file_.get(), VIDIOC_S_FMT, &format), "format");
    given_ = pixels;
    const cv::Size got(static_cast<int>(given_.width), static_cast<int>(given_.height));
    if (given_.pixelformat != wanted || got != size) {
      remarks_.push_back("asked for " + fourccText(wanted) + " " + std::to_string(size.width) +
                         "x" + std::to_string(size.height) + ", the driver gave " +
                         fourccText(given_.pixelformat) + " " + std::to_string(got.width) + "x" +
                         std::to_string(got.height));
    }
    format_ = findV4l2Format(given_.pixelformat);
    if (!format_) {
      throw CameraError(device_.path + " streams in " + fourccText(given_.pixelformat) +
                        ", for which there is no encoding; it offers " + names);
    }
    // Drivers may leave the step out.
    const std::size_t pixel = format_->coding == V4l2Coding::kPlain
                                  ? static_cast<std::size_t>(CV_ELEM_SIZE(format_->type))
                              : format_->coding == V4l2Coding::kNv12 ? 1
                                                                     : 2;
    step_ = std::max<std::size_t>(given_.bytesperline, pixel * given_.width);
    if (format_->coding == V4l2Coding::kNv12 && (given_.width % 2 != 0 || given_.height % 2 != 0)) {
      throw CameraError(device_.path + ": NV12 needs an even size");
    }
    if (given_.width == 0 || given_.height == 0 || step_ * given_.height > kMaxImageBytes) {
      throw CameraError(device_.path + " gives frames of " + std::to_string(given_.width) + "x" +
                        std::to_string(given_.height));
    }
  }

  void setFrameRate(double rate) {
    v4l2_streamparm parameters{};
    parameters.type = kCapture;
    constexpr std::uint32_t kParts = 1000;
    parameters.parm.capture.timeperframe = {kParts,
                                            static_cast<std::uint32_t>(std::lround(rate * kParts))};
    if (control(file_.get(), VIDIOC_S_PARM, &parameters) != 0) {
      if (errno == ENODEV) fail("frame rate");
      remarks_.push_back(std::string("frame rate: ") + std::strerror(errno));
      return;
    }
    const v4l2_fract& time = parameters.parm.capture.timeperframe;
    const double got =
        time.numerator > 0 ? static_cast<double>(time.denominator) / time.numerator : 0.0;
    if (std::abs(got - rate) > 0.01 * rate) {
      remarks_.push_back("frame rate: asked for " + formatNumber(rate) + ", the camera took " +
                         formatNumber(got) + " Hz");
    }
  }

  std::optional<std::int32_t> get(std::uint32_t id) const {
    v4l2_control value{};
    value.id = id;
    if (control(file_.get(), VIDIOC_G_CTRL, &value) != 0) return std::nullopt;
    return value.value;
  }

  /// Within the control's limits, told where that is another value.
  void set(std::uint32_t id, const std::string& name, double wanted, double unit = 1.0) {
    v4l2_queryctrl query{};
    query.id = id;
    if (control(file_.get(), VIDIOC_QUERYCTRL, &query) != 0 ||
        (query.flags & V4L2_CTRL_FLAG_DISABLED) != 0) {
      remarks_.push_back("this camera has no " + name);
      return;
    }
    v4l2_control value{};
    value.id = id;
    value.value = static_cast<std::int32_t>(std::lround(std::clamp(
        wanted / unit, static_cast<double>(query.minimum), static_cast<double>(query.maximum))));
    if (control(file_.get(), VIDIOC_S_CTRL, &value) != 0) {
      if (errno == ENODEV) fail(name);
      remarks_.push_back(name + ": " + std::strerror(errno));
      return;
    }
    const double got = get(id).value_or(value.value) * unit;
    if (std::abs(got - wanted) > std::max(0.5 * unit, 0.01 * std::abs(wanted))) {
      remarks_.push_back(name + ": asked for " + formatNumber(wanted) + ", the camera took " +
                         formatNumber(got));
    }
  }

  void apply(const CameraControls& wanted) {
    if (!wanted.exposure_auto.empty()) {
      if (wanted.exposure_auto == "off") {
        set(V4L2_CID_EXPOSURE_AUTO, "exposure mode", V4L2_EXPOSURE_MANUAL);
      } else {
        // UVC cameras know this automatic mode, others the plain one.
        v4l2_control value{};
        value.id = V4L2_CID_EXPOSURE_AUTO;
        value.value = V4L2_EXPOSURE_APERTURE_PRIORITY;
        if (control(file_.get(), VIDIOC_S_CTRL, &value) != 0) {
          set(V4L2_CID_EXPOSURE_AUTO, "exposure mode", V4L2_EXPOSURE_AUTO);
        }
      }
    }
    if (wanted.exposure_us) {
      set(V4L2_CID_EXPOSURE_ABSOLUTE, "exposure time", *wanted.exposure_us, 100.0);
    }
    if (!wanted.gain_auto.empty()) {
      set(V4L2_CID_AUTOGAIN, "automatic gain", wanted.gain_auto == "off" ? 0.0 : 1.0);
    }
    if (wanted.gain) set(V4L2_CID_GAIN, "gain", *wanted.gain);
    if (wanted.black_level) remarks_.emplace_back("V4L2 cameras have no black level");
  }

  void setByName(const std::string& feature) {
    const std::size_t equals = feature.find('=');
    const std::string name = controlName(feature.substr(0, equals));
    const std::string value = equals == std::string::npos ? "" : feature.substr(equals + 1);
    std::string names;
    v4l2_queryctrl query{};
    query.id = V4L2_CTRL_FLAG_NEXT_CTRL;
    for (int i = 0; i < 1024 && control(file_.get(), VIDIOC_QUERYCTRL, &query) == 0; ++i) {
      if (query.type != V4L2_CTRL_TYPE_CTRL_CLASS && (query.flags & V4L2_CTRL_FLAG_DISABLED) == 0) {
        const std::string known = controlName(text(query.name));
        names += (names.empty() ? "" : ", ") + known;
        if (known == name) {
          setValue(query, name, value);
          return;
        }
      }
      query.id |= V4L2_CTRL_FLAG_NEXT_CTRL;
    }
    remarks_.push_back("no control \"" + printable(name) + "\"; there are: " + names);
  }

  void setValue(const v4l2_queryctrl& query, const std::string& name, const std::string& value) {
    if (query.type == V4L2_CTRL_TYPE_MENU) {
      for (std::int64_t i = query.minimum; i <= query.maximum; ++i) {
        v4l2_querymenu item{};
        item.id = query.id;
        item.index = static_cast<std::uint32_t>(i);
        if (control(file_.get(), VIDIOC_QUERYMENU, &item) == 0 &&
            controlName(text(item.name)) == controlName(value)) {
          set(query.id, name, static_cast<double>(i));
          return;
        }
      }
    }
    const std::optional<double> number = value == "true"    ? 1.0
                                         : value == "false" ? 0.0
                                                            : parseNumber(value);
    if (!number || !std::isfinite(*number)) {
      remarks_.push_back(name + ": \"" + printable(value) + "\" is no value of it");
      return;
    }
    set(query.id, name, *number);
  }

  cv::Size imageSize() const {
    return {static_cast<int>(given_.width), static_cast<int>(given_.height)};
  }

  std::optional<Frame> take(const v4l2_buffer& buffer) {
    if (buffer.index >= mappings_.size())
      throw CameraError(device_.path + " gives a frame nobody knows");
    const Mapping& mapping = mappings_[buffer.index];
    const std::size_t used = std::min<std::size_t>(buffer.bytesused, mapping.length());
    Frame frame;
    frame.sequence = sequenceOf(buffer.sequence);
    frame.stamp = stampOf(buffer);
    frame.encoding = format_->encoding;
    if ((buffer.flags & V4L2_BUF_FLAG_ERROR) != 0 ||
        !decodeV4l2(*format_, mapping.data(), used, imageSize(), step_, pool_.get(), &frame)) {
      ++statistics_.incomplete;
      return std::nullopt;
    }
    ++statistics_.complete;
    return frame;
  }

  std::uint64_t sequenceOf(std::uint32_t number) {
    sequence_ += last_number_ ? std::max<std::uint32_t>(1, number - *last_number_) : 1;
    last_number_ = number;
    return sequence_;
  }

  Stamp stampOf(const v4l2_buffer& buffer) const {
    const nanoseconds exposure(std::llround(exposure_us_ * 1e3));
    const nanoseconds extra(std::llround(settings_.stamp_offset_us * 1e3));
    const Stamp arrival = now();
    if ((buffer.flags & V4L2_BUF_FLAG_TIMESTAMP_MASK) != V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC) {
      return arrival - exposure / 2 + extra;
    }
    timespec monotonic{};
    clock_gettime(CLOCK_MONOTONIC, &monotonic);
    const auto since = [](const auto& time, std::int64_t parts, std::int64_t nanoseconds_a_part) {
      return static_cast<std::int64_t>(time.tv_sec) * 1000000000 + parts * nanoseconds_a_part;
    };
    const nanoseconds age(since(monotonic, monotonic.tv_nsec, 1) -
                          since(buffer.timestamp, buffer.timestamp.tv_usec, 1000));
    const bool at_start =
        (buffer.flags & V4L2_BUF_FLAG_TSTAMP_SRC_MASK) == V4L2_BUF_FLAG_TSTAMP_SRC_SOE;
    return arrival - age + (at_start ? exposure / 2 : -exposure / 2) + extra;
  }

  const File file_;
  const V4l2Device device_;
  const CameraSettings settings_;
  const std::shared_ptr<FramePool> pool_;
  std::vector<std::string> remarks_, details_;
  std::vector<Mapping> mappings_;
  const V4l2Format* format_ = nullptr;
  v4l2_pix_format given_{};
  std::size_t step_ = 0;
  double exposure_us_ = 0.0;
  std::optional<std::uint32_t> last_number_;
  std::uint64_t sequence_ = 0;
  CameraStatistics statistics_;
};

/// Device files by number.
std::vector<std::string> deviceFiles() {
  std::vector<std::pair<int, std::string>> found;
  std::error_code error;
  for (fs::directory_iterator item("/dev", error), end; !error && item != end;
       item.increment(error)) {
    const std::string name = item->path().filename().string();
    if (name.rfind("video", 0) != 0) continue;
    if (const std::optional<double> number = parseNumber(name.substr(5))) {
      found.emplace_back(static_cast<int>(*number), item->path().string());
    }
  }
  std::sort(found.begin(), found.end());
  std::vector<std::string> paths;
  for (auto& [number, path] : found) paths.push_back(std::move(path));
  return paths;
}

}  // namespace

std::vector<V4l2Device> listV4l2Devices() {
  std::vector<V4l2Device> devices;
  for (const std::string& path : deviceFiles()) {
    const File file(path);
    if (!file) continue;
    if (std::optional<V4l2Device> device = identify(file.get(), path)) {
      devices.push_back(std::move(*device));
    }
  }
  return devices;
}

std::unique_ptr<Camera> openV4l2Camera(const std::string& which, const CameraSettings& settings) {
  std::vector<std::string> remarks;
  std::string path;
  if (!which.empty() && which[0] == '/') {
    path = which;
  } else if (!which.empty() && which.find('/') == std::string::npos) {
    for (const char* folder : {"/dev/v4l/by-id/", "/dev/v4l/by-path/"}) {
      std::error_code ignored;
      if (path.empty() && fs::exists(folder + which, ignored)) path = folder + which;
    }
  }
  const auto openPath = [&](const std::string& what) -> std::unique_ptr<Camera> {
    File file(what);
    if (!file) throwCannotOpen(what, errno);
    std::optional<V4l2Device> device = identify(file.get(), what);
    if (!device) throw CameraError(printable(what) + " is no camera");
    if (settings.identity && !same(device->identity, *settings.identity)) return nullptr;
    return std::make_unique<V4l2Camera>(std::move(file), std::move(*device), settings,
                                        std::move(remarks));
  };
  std::error_code ignored;
  if (!path.empty() && (!settings.identity || fs::exists(path, ignored))) {
    if (std::unique_ptr<Camera> camera = openPath(path)) return camera;
  }
  const std::vector<V4l2Device> all = listV4l2Devices();
  std::vector<V4l2Device> found;
  std::copy_if(all.begin(), all.end(), std::back_inserter(found), [&](const V4l2Device& d) {
    if (settings.identity) return same(d.identity, *settings.identity);
    return which.empty() || which == d.bus || which == d.identity.serial ||
           which == d.identity.model;
  });
  if (found.empty()) {
    const std::string wanted = settings.identity ? "the camera " + settings.identity->model + " " +
                                                       settings.identity->serial + " is gone"
                               : which.empty() ? "no camera is there"
                                               : "no camera \"" + which + "\" is there";
    throw CameraError(printable(wanted) +
                      (all.empty() ? "; none is found" : "; there are: " + list(all)));
  }
  if (!settings.identity && (which.empty() || found.size() > 1)) {
    remarks.push_back((which.empty() ? "the device names no camera" : "several cameras fit") +
                      std::string(", taking ") + found.front().path + " of: " + list(found));
  }
  std::unique_ptr<Camera> camera = openPath(found.front().path);
  if (!camera) throw CameraError(found.front().path + " is another camera now");
  return camera;
}

}  // namespace omnister::device
