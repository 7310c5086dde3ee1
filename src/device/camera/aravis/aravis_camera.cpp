// SPDX-License-Identifier: Apache-2.0
#include "device/camera/aravis/aravis_camera.h"

#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>

#include "device/camera/aravis/aravis_clock.h"
#include "device/camera/aravis/aravis_connection.h"
#include "device/camera/aravis/aravis_discovery.h"
#include "device/camera/aravis/aravis_features.h"
#include "device/camera/pixel_format.h"

namespace omnister::device {
namespace {

using Steady = std::chrono::steady_clock;
using std::chrono::microseconds;
using std::chrono::milliseconds;
using std::chrono::seconds;

constexpr std::size_t kMaxPayload = std::size_t{1} << 30;
constexpr int kLeastSocketBuffer = 2 << 20, kMostSocketBuffer = 64 << 20;
// On loopback packets are as large as the protocol allows.
constexpr int kLoopbackPacket = 16000;
constexpr seconds kTemperatureAgain(5);
// Of so many frames' packets in the kernel's memory none gets lost while others have the processor.
constexpr std::size_t kFramesThatWait = 2;

/// The kernel's limit of a socket's receive buffer.
long kernelSocketBuffer() {
  std::ifstream file("/proc/sys/net/core/rmem_max");
  long value = 0;
  return file >> value ? value : 0;
}

class AravisCamera : public Camera {
 public:
  AravisCamera(const AravisDevice& device, const CameraSettings& settings,
               std::vector<std::string> remarks)
      : settings_(settings),
        pool_(FramePool::make(static_cast<std::size_t>(settings.buffers) + 8)),
        on_(device, std::move(remarks)),
        clock_(on_),
        link_(device.protocol + (device.address.empty() ? "" : " " + device.address)) {
    applySettings(on_, settings);
    clock_.configure(settings);
    if (on_.gige()) tuneGige();
    region_ = readGeometry(on_);
  }

  ~AravisCamera() override {
    if (!on_.gone()) {
      stop();
    } else if (stream_) {
      on_.closeLater(std::move(stream_));
    }
  }

  CameraIdentity identity() const override { return on_.device().identity; }
  bool live() const override { return true; }
  void abandon() override { on_.abandon(); }

  void start() override {
    on_.requireAlive();
    region_ = readGeometry(on_);
    Failure failure;
    const guint payload = arv_camera_get_payload(on_.camera(), failure.out());
    on_.refuseIf(failure, "the size of its frames");
    if (payload == 0 || payload > kMaxPayload) {
      throw CameraError("the camera says that its frames have " + std::to_string(payload) +
                        " bytes");
    }
    payload_ = payload;
    const bool hurry = static_cast<std::size_t>(socketBuffer()) < kFramesThatWait * payload_;
    stream_.reset(arv_camera_create_stream(on_.camera(), hurry ? &AravisCamera::hurry : nullptr,
                                           nullptr, failure.out()));
    on_.refuseIf(failure, "no stream can be opened");
    if (ARV_IS_GV_STREAM(stream_.get())) tuneGigeStream();
    for (int i = 0; i < settings_.buffers; ++i) pushIdleBuffer();
    clock_.prepare();
    arv_camera_start_acquisition(on_.camera(), failure.out());
    on_.refuseIf(failure, "it does not start");
    last_id_.reset();
  }

  void stop() override {
    if (!stream_) return;
    Failure failure;
    arv_camera_stop_acquisition(on_.camera(), failure.out());
    if (failure) on_.detail("stopping: " + failure.text());
    past_ = totals();
    stream_.reset();
  }

  std::optional<Frame> grab(milliseconds timeout) override {
    const Steady::time_point until = Steady::now() + timeout;
    if (!stream_) return std::nullopt;
    while (true) {
      on_.requireAlive();
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

  std::vector<std::string> takeRemarks() override { return on_.takeRemarks(); }
  std::vector<std::string> takeDetails() override { return on_.takeDetails(); }

  CameraControls controls() override {
    CameraControls now = readControls(on_);
    if (now.exposure_us) clock_.setExposure(*now.exposure_us);
    return now;
  }

  CameraControls setControls(const CameraControls& wanted) override {
    device::setControls(on_, wanted, settings_.trigger != "off");
    return controls();
  }

  void trigger() override {
    on_.requireAlive();
    Failure failure;
    arv_camera_software_trigger(on_.camera(), failure.out());
    on_.refuseIf(failure, "no software trigger");
  }

  CameraStatistics statistics() override {
    CameraStatistics now = stream_ ? totals() : past_;
    now.incomplete = incomplete_;
    if (Steady::now() >= temperature_due_ && !on_.gone()) {
      temperature_due_ = Steady::now() + kTemperatureAgain;
      temperature_ = readNumber(on_, "DeviceTemperature");
    }
    now.temperature_c = temperature_;
    now.link = link_;
    return now;
  }

 private:
  /// In the thread that takes packets from the kernel, where the kernel does not keep them for
  /// long: then it must not wait for others, which costs a wake-up a packet. Without the right to,
  /// it stays as it is.
  static void hurry(void* /*data*/, ArvStreamCallbackType type, ArvBuffer* /*buffer*/) {
    if (type != ARV_STREAM_CALLBACK_TYPE_INIT) return;
    constexpr int kAboveOthers = -10;
    setpriority(PRIO_PROCESS, static_cast<id_t>(syscall(SYS_gettid)), kAboveOthers);
  }

  /// Wanted of the kernel, in which packets wait for us [bytes].
  int wantedSocketBuffer() const {
    if (settings_.socket_buffer_bytes > 0) return settings_.socket_buffer_bytes;
    return static_cast<int>(
        std::clamp<long>(4L * static_cast<long>(payload_), kLeastSocketBuffer, kMostSocketBuffer));
  }
  /// As the kernel gives it.
  int socketBuffer() const {
    const long limit = kernelSocketBuffer();
    const int wanted = wantedSocketBuffer();
    return limit > 0 ? static_cast<int>(std::min<long>(limit, wanted)) : wanted;
  }

  void tuneGige() {
    Failure failure;
    ArvCamera* camera = on_.camera();
    arv_camera_gv_set_packet_size_adjustment(camera, ARV_GV_PACKET_SIZE_ADJUSTMENT_NEVER);
    if (settings_.packet_size > 0) {
      arv_camera_gv_set_packet_size(camera, settings_.packet_size, failure.out());
    } else if (on_.local()) {
      arv_camera_gv_set_packet_size(camera, kLoopbackPacket, failure.out());
    } else {
      arv_camera_gv_auto_packet_size(camera, failure.out());
    }
    on_.tellIf(failure, "packet size");
    const guint size = arv_camera_gv_get_packet_size(camera, failure.out());
    if (!failure) link_ += ", packets of " + std::to_string(size) + " B";
    if (settings_.packet_delay_us > 0) {
      arv_camera_gv_set_packet_delay(camera, gint64{1000} * settings_.packet_delay_us,
                                     failure.out());
      on_.tellIf(failure, "packet delay");
    }
    // What a packet socket listens to is the wire, and a camera of this host does not use it.
    arv_camera_gv_set_stream_options(camera, on_.local()
                                                 ? ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED
                                                 : ARV_GV_STREAM_OPTION_NONE);
  }

  void tuneGigeStream() {
    const int bytes = wantedSocketBuffer();
    g_object_set(stream_.get(), "socket-buffer", ARV_GV_STREAM_SOCKET_BUFFER_FIXED,
                 "socket-buffer-size", static_cast<gint>(bytes), "packet-resend",
                 settings_.packet_resend ? ARV_GV_STREAM_PACKET_RESEND_ALWAYS
                                         : ARV_GV_STREAM_PACKET_RESEND_NEVER,
                 nullptr);
    const long limit = kernelSocketBuffer();
    if (limit > 0 && limit < kLeastSocketBuffer && !told_limit_) {
      told_limit_ = true;
      on_.remark("the kernel allows sockets " + std::to_string(limit) +
                 " bytes, packets may get lost: sysctl -w net.core.rmem_max=" +
                 std::to_string(std::max(bytes, kLeastSocketBuffer)));
    }
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

  /// The memory that a buffer fills, and keeps while it waits in the stream.
  static FrameMemoryPtr& memoryOf(ArvBuffer* buffer) {
    return *static_cast<FrameMemoryPtr*>(const_cast<void*>(arv_buffer_get_user_data(buffer)));
  }

  /// Idle memory goes into the stream, in the buffer that it had before, if any.
  void pushIdleBuffer() {
    FrameMemoryPtr memory = pool_->take(payload_);
    const std::shared_ptr<void> before = std::move(memory->wrapping);
    auto* buffer = static_cast<ArvBuffer*>(before.get());
    std::size_t bytes = 0;
    if (buffer && arv_buffer_get_data(buffer, &bytes) == memory->bytes.data() &&
        bytes == payload_) {
      g_object_ref(buffer);
    } else {
      buffer =
          arv_buffer_new_full(payload_, memory->bytes.data(), new FrameMemoryPtr,
                              [](gpointer slot) { delete static_cast<FrameMemoryPtr*>(slot); });
    }
    memoryOf(buffer) = std::move(memory);
    arv_stream_push_buffer(stream_.get(), buffer);
  }

  /// Takes the buffer; it or one like it goes back into the stream.
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
        on_.remark("frames of a kind that is not known are left out");
      }
      arv_stream_push_buffer(stream_.get(), buffer);
      return std::nullopt;
    }
    Frame frame;
    frame.encoding = format->encoding;
    frame.stamp = clock_.stampOf(buffer);
    frame.number = arv_buffer_get_frame_id(buffer);
    frame.sequence = sequenceOf(frame.number);
    frame.region = region_;
    const bool whole_samples = step % CV_ELEM_SIZE1(format->type) == 0;
    if (format->direct() && whole_samples && memoryOf(buffer)->bytes.data() == data) {
      frame.memory = std::move(memoryOf(buffer));
      frame.memory->wrapping = std::shared_ptr<void>(buffer, g_object_unref);
      frame.image = cv::Mat(size, format->type, frame.memory->bytes.data(), step);
      pushIdleBuffer();
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

  const CameraSettings settings_;
  const std::shared_ptr<FramePool> pool_;
  AravisConnection on_;
  AravisClock clock_;
  Object<ArvStream> stream_;
  bool told_limit_ = false, told_format_ = false;
  std::string link_;
  std::size_t payload_ = 0;
  std::optional<SensorRegion> region_;
  Steady::time_point temperature_due_;
  std::optional<guint64> last_id_;
  std::uint64_t sequence_ = 0;
  std::uint64_t incomplete_ = 0;
  CameraStatistics past_;
  std::optional<double> temperature_;
};

}  // namespace

std::unique_ptr<Camera> openAravisCamera(const std::string& which, const CameraSettings& settings) {
  std::vector<std::string> remarks;
  const AravisDevice device = findAravisDevice(which, settings, &remarks);
  return std::make_unique<AravisCamera>(device, settings, std::move(remarks));
}

}  // namespace omnister::device
