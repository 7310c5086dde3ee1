// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/gige_server.h"

#include <arv.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstring>
#include <filesystem>
#include <mutex>
#include <opencv2/imgproc.hpp>
#include <optional>
#include <thread>

#include "omnister/common/numbers.h"
#include "sim/camera/gige_wire.h"

namespace omnister::sim {
namespace {

using device::Stamp;
using std::chrono::microseconds;
using std::chrono::milliseconds;
using std::chrono::nanoseconds;
using Steady = std::chrono::steady_clock;

// Registers of the protocol.
constexpr guint32 kManufacturer = 0x48, kModel = 0x68, kNameBytes = 32;
// Registers beyond those of Aravis' fake camera.
constexpr guint32 kFramePeriod = 0x8000;
constexpr guint32 kTriggerMode = 0x8010, kTriggerSource = 0x8014, kTriggerSoftware = 0x8018;
constexpr guint32 kGain = 0x8020, kBlackLevel = 0x8024, kTemperature = 0x8028;
constexpr guint32 kPtpEnable = 0x802c, kPtpStatus = 0x8030;
constexpr guint32 kLatch = 0x8034, kLatchValue = 0x8038;
constexpr guint32 kChunkMode = 0x8040, kChunkSelector = 0x8044, kChunkEnable = 0x8050;
// What is appended to an image, each with its identity and length behind it.
enum Chunk : guint32 { kImageChunk = 0x0e00, kExposureChunk = 0x0e01, kTimestampChunk = 0x0e02 };
constexpr int kChunkBytes = 8, kChunkTail = 8;

constexpr ArvPixelFormat kMono8 = ARV_PIXEL_FORMAT_MONO_8, kMono16 = ARV_PIXEL_FORMAT_MONO_16,
                         kBayer = ARV_PIXEL_FORMAT_BAYER_RG_8, kRgb = ARV_PIXEL_FORMAT_RGB_8_PACKED,
                         kBgr = ARV_PIXEL_FORMAT_BGR_8_PACKED;

constexpr std::size_t kMaxSerial = 15;
constexpr int kMaxSide = 8192;
// How often the server looks at what was written to its registers.
constexpr milliseconds kTick(1);
// The clock of the camera, while it runs freely, is not the host's.
constexpr std::int64_t kClockAhead = 123456789000LL;

std::string number(guint32 value) { return std::to_string(value); }

std::string registerXml(const std::string& name, guint32 address, const char* access,
                        int length = 4) {
  return "<IntReg Name=\"" + name + "\"><Address>" + number(address) + "</Address><Length>" +
         std::to_string(length) + "</Length><AccessMode>" + access +
         "</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable><Sign>Unsigned</Sign>"
         "<Endianess>BigEndian</Endianess></IntReg>\n";
}

std::string stringXml(const std::string& name, guint32 address, int length) {
  return "<StringReg Name=\"" + name + "\"><Address>" + number(address) + "</Address><Length>" +
         std::to_string(length) +
         "</Length><AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>\n";
}

/// @param max a number, or the name of the feature that holds it
std::string integerXml(const std::string& name, guint32 address, int min, const std::string& max) {
  const bool named = std::isdigit(static_cast<unsigned char>(max[0])) == 0;
  return "<Integer Name=\"" + name + "\"><pValue>" + name + "Reg</pValue><Min>" +
         std::to_string(min) + "</Min>" +
         (named ? "<pMax>" + max + "</pMax>" : "<Max>" + max + "</Max>") +
         "<Inc>1</Inc></Integer>\n" + registerXml(name + "Reg", address, "RW");
}

/// A number whose register holds an integer. @param to from the value FROM, @param from of the
/// register TO
std::string floatXml(const std::string& name, guint32 address, const char* access, double min,
                     double max, const std::string& to, const std::string& from) {
  return "<Float Name=\"" + name + "\"><pValue>" + name + "Conv</pValue><Min>" + formatNumber(min) +
         "</Min><Max>" + formatNumber(max) + "</Max></Float>\n<Converter Name=\"" + name +
         "Conv\"><FormulaTo>" + to + "</FormulaTo><FormulaFrom>" + from + "</FormulaFrom><pValue>" +
         name + "Reg</pValue></Converter>\n" + registerXml(name + "Reg", address, access);
}

std::string choiceXml(const std::string& name, guint32 address, const char* access,
                      std::initializer_list<std::pair<const char*, guint32>> entries) {
  std::string text = "<Enumeration Name=\"" + name + "\">";
  for (const auto& [word, value] : entries) {
    text += std::string("<EnumEntry Name=\"") + word + "\"><Value>" + number(value) +
            "</Value></EnumEntry>";
  }
  return text + "<pValue>" + name + "Reg</pValue></Enumeration>\n" +
         registerXml(name + "Reg", address, access);
}

std::string booleanXml(const std::string& name) {
  return "<Boolean Name=\"" + name + "\"><pValue>" + name +
         "Reg</pValue><OnValue>1</OnValue><OffValue>0</OffValue></Boolean>\n";
}

/// What a frame tells of itself, eight bytes behind the image. @param kind IntReg or FloatReg
std::string chunkXml(const std::string& name, const char* kind, const char* identity) {
  return std::string("<") + kind + " Name=\"" + name + "\"><Address>0</Address><Length>" +
         std::to_string(kChunkBytes) + "</Length><AccessMode>RO</AccessMode><pPort>" + name +
         "Port</pPort><Endianess>BigEndian</Endianess></" + kind + ">\n<Port Name=\"" + name +
         "Port\" NameSpace=\"Standard\"><ChunkID>" + identity + "</ChunkID></Port>\n";
}

std::string commandXml(const std::string& name, guint32 address, int value) {
  return "<Command Name=\"" + name + "\"><pValue>" + name + "Reg</pValue><CommandValue>" +
         std::to_string(value) + "</CommandValue></Command>\n" +
         registerXml(name + "Reg", address, "RW");
}

/// What the camera says that it can do.
std::string description() {
  std::string xml =
      "<?xml version=\"1.0\" encoding=\"utf-8\"?>\n"
      "<RegisterDescription ModelName=\"Simulated\" VendorName=\"OMNister\" "
      "StandardNameSpace=\"None\" SchemaMajorVersion=\"1\" SchemaMinorVersion=\"0\" "
      "SchemaSubMinorVersion=\"1\" MajorVersion=\"1\" MinorVersion=\"0\" SubMinorVersion=\"0\" "
      "ToolTip=\"Simulated camera\" ProductGuid=\"0\" VersionGuid=\"0\" "
      "xmlns=\"http://www.genicam.org/GenApi/Version_1_0\">\n"
      "<Category Name=\"Root\" NameSpace=\"Standard\">";
  for (const char* feature : {"DeviceVendorName",
                              "DeviceModelName",
                              "DeviceID",
                              "DeviceTemperature",
                              "SensorWidth",
                              "SensorHeight",
                              "Width",
                              "Height",
                              "OffsetX",
                              "OffsetY",
                              "BinningHorizontal",
                              "BinningVertical",
                              "PixelFormat",
                              "PayloadSize",
                              "AcquisitionMode",
                              "AcquisitionStart",
                              "AcquisitionStop",
                              "AcquisitionFrameRate",
                              "ExposureTime",
                              "Gain",
                              "BlackLevel",
                              "TriggerSelector",
                              "TriggerMode",
                              "TriggerSource",
                              "TriggerActivation",
                              "TriggerSoftware",
                              "TimestampLatch",
                              "TimestampLatchValue",
                              "PtpEnable",
                              "PtpStatus",
                              "ChunkModeActive",
                              "ChunkSelector",
                              "ChunkEnable",
                              "ChunkExposureTime",
                              "ChunkTimestamp"}) {
    xml += std::string("<pFeature>") + feature + "</pFeature>";
  }
  xml += "</Category>\n";
  xml += stringXml("DeviceVendorName", kManufacturer, kNameBytes);
  xml += stringXml("DeviceModelName", kModel, kNameBytes);
  xml += stringXml("DeviceID", 0xd8, 16);
  xml += floatXml("DeviceTemperature", kTemperature, "RO", 0, 100, "FROM * 100", "TO / 100.0");
  xml += registerXml("SensorWidth", ARV_FAKE_CAMERA_REGISTER_SENSOR_WIDTH, "RO");
  xml += registerXml("SensorHeight", ARV_FAKE_CAMERA_REGISTER_SENSOR_HEIGHT, "RO");
  xml += integerXml("Width", ARV_FAKE_CAMERA_REGISTER_WIDTH, 1, "SensorWidth");
  xml += integerXml("Height", ARV_FAKE_CAMERA_REGISTER_HEIGHT, 1, "SensorHeight");
  xml += integerXml("OffsetX", ARV_FAKE_CAMERA_REGISTER_X_OFFSET, 0, "SensorWidth");
  xml += integerXml("OffsetY", ARV_FAKE_CAMERA_REGISTER_Y_OFFSET, 0, "SensorHeight");
  xml += integerXml("BinningHorizontal", ARV_FAKE_CAMERA_REGISTER_BINNING_HORIZONTAL, 1, "4");
  xml += integerXml("BinningVertical", ARV_FAKE_CAMERA_REGISTER_BINNING_VERTICAL, 1, "4");
  xml += choiceXml("PixelFormat", ARV_FAKE_CAMERA_REGISTER_PIXEL_FORMAT, "RW",
                   {{"Mono8", kMono8},
                    {"Mono16", kMono16},
                    {"BayerRG8", kBayer},
                    {"RGB8", kRgb},
                    {"BGR8", kBgr}});
  xml +=
      "<IntSwissKnife Name=\"PayloadSize\"><pVariable Name=\"W\">Width</pVariable>"
      "<pVariable Name=\"H\">Height</pVariable><pVariable Name=\"F\">PixelFormat</pVariable>"
      "<pVariable Name=\"C\">ChunkModeActiveReg</pVariable>"
      "<Formula>W * H * ((F &gt;&gt; 16) &amp; 0xFF) / 8 + C * " +
      std::to_string(2 * kChunkBytes + 3 * kChunkTail) + "</Formula></IntSwissKnife>\n";
  xml += choiceXml("AcquisitionMode", ARV_FAKE_CAMERA_REGISTER_ACQUISITION_MODE, "RW",
                   {{"Continuous", 1}});
  xml += commandXml("AcquisitionStart", ARV_FAKE_CAMERA_REGISTER_ACQUISITION, 1);
  xml +=
      "<Command Name=\"AcquisitionStop\"><pValue>AcquisitionStartReg</pValue>"
      "<CommandValue>0</CommandValue></Command>\n";
  xml += floatXml("AcquisitionFrameRate", kFramePeriod, "RW", 0.05, 1000, "1000000 / FROM",
                  "1000000.0 / TO");
  xml += floatXml("ExposureTime", ARV_FAKE_CAMERA_REGISTER_EXPOSURE_TIME_US, "RW", 10, 1000000,
                  "FROM", "TO");
  xml += floatXml("Gain", kGain, "RW", 0, 24, "FROM * 100", "TO / 100.0");
  xml += floatXml("BlackLevel", kBlackLevel, "RW", 0, 64, "FROM * 100", "TO / 100.0");
  xml +=
      "<Enumeration Name=\"TriggerSelector\"><EnumEntry Name=\"FrameStart\"><Value>0</Value>"
      "</EnumEntry><pValue>TriggerSelectorValue</pValue></Enumeration>\n"
      "<Integer Name=\"TriggerSelectorValue\"><Value>0</Value></Integer>\n"
      "<Enumeration Name=\"TriggerActivation\"><EnumEntry Name=\"RisingEdge\"><Value>0</Value>"
      "</EnumEntry><pValue>TriggerActivationValue</pValue></Enumeration>\n"
      "<Integer Name=\"TriggerActivationValue\"><Value>0</Value></Integer>\n";
  xml += choiceXml("TriggerMode", kTriggerMode, "RW", {{"Off", 0}, {"On", 1}});
  xml += choiceXml("TriggerSource", kTriggerSource, "RW", {{"Line0", 0}, {"Software", 1}});
  xml += commandXml("TriggerSoftware", kTriggerSoftware, 1);
  xml += commandXml("TimestampLatch", kLatch, 1);
  xml += registerXml("TimestampLatchValue", kLatchValue, "RO", 8);
  xml += booleanXml("PtpEnable") + registerXml("PtpEnableReg", kPtpEnable, "RW");
  xml += choiceXml("PtpStatus", kPtpStatus, "RO", {{"Disabled", 3}, {"Slave", 9}});
  xml += booleanXml("ChunkModeActive") + registerXml("ChunkModeActiveReg", kChunkMode, "RW");
  xml += choiceXml("ChunkSelector", kChunkSelector, "RW", {{"ExposureTime", 0}, {"Timestamp", 1}});
  xml += booleanXml("ChunkEnable") + "<IntReg Name=\"ChunkEnableReg\"><Address>" +
         number(kChunkEnable) +
         "</Address><pIndex Offset=\"4\">ChunkSelectorReg</pIndex><Length>4</Length>"
         "<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
         "<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>\n";
  xml += chunkXml("ChunkExposureTime", "FloatReg", "0e01");
  xml += chunkXml("ChunkTimestamp", "IntReg", "0e02");
  xml += "<Integer Name=\"TLParamsLocked\"><Value>0</Value><Min>0</Min><Max>1</Max></Integer>\n";
  xml += "<Port Name=\"Device\" NameSpace=\"Standard\"></Port>\n</RegisterDescription>\n";
  return xml;
}

/// The description as a file, which is how the fake camera wants it; gone with this object.
class DescriptionFile {
 public:
  DescriptionFile() {
    path_ = (std::filesystem::temp_directory_path() / "omnister_camera_XXXXXX").string();
    const int file = mkstemp(path_.data());
    if (file < 0) throw IoError("create", path_, errno);
    const std::string text = description();
    const bool whole = write(file, text.data(), text.size()) == static_cast<ssize_t>(text.size());
    const int reason = errno;
    ::close(file);
    if (!whole) {
      unlink(path_.c_str());
      throw IoError("write", path_, reason);
    }
  }
  ~DescriptionFile() { unlink(path_.c_str()); }
  DescriptionFile(const DescriptionFile&) = delete;
  DescriptionFile& operator=(const DescriptionFile&) = delete;
  const char* path() const { return path_.c_str(); }

 private:
  std::string path_;
};

void check(const GigeServerOptions& options) {
  const auto refuse = [](const char* key, const std::string& problem) {
    throw InputError("simulated camera", key, problem);
  };
  const auto within = [&refuse](const char* key, double value, double min, double max) {
    if (value >= min && value <= max) return;
    refuse(key, "is " + formatNumber(value) + ", expected " + formatNumber(min) + " to " +
                    formatNumber(max));
  };
  within("frame_rate", options.frame_rate_hz, 0.05, 1000.0);
  within("exposure", options.exposure_us, 10.0, 1e6);
  within("packet_loss", options.packet_loss, 0.0, 1.0);
  within("width", options.size.width, 2, kMaxSide);
  within("height", options.size.height, 2, kMaxSide);
  if (options.serial.empty() || options.serial.size() > kMaxSerial) {
    refuse("serial", "is \"" + printable(options.serial) + "\", expected 1 to " +
                         std::to_string(kMaxSerial) + " characters");
  }
}

/// One colour a pixel, as under a filter of red and green over green and blue.
cv::Mat mosaic(const cv::Mat& bgr) {
  cv::Mat out(bgr.size(), CV_8UC1);
  for (int y = 0; y < bgr.rows; ++y) {
    const cv::Vec3b* in = bgr.ptr<cv::Vec3b>(y);
    std::uint8_t* to = out.ptr(y);
    for (int x = 0; x < bgr.cols; ++x) to[x] = in[x][2 - (y % 2) - (x % 2)];
  }
  return out;
}

/// @return empty for a format that the camera does not have
cv::Mat toPixelFormat(const cv::Mat& image, guint32 format) {
  const bool color = image.channels() == 3;
  cv::Mat out;
  if (format == kMono8 || format == kMono16) {
    if (color) {
      cv::cvtColor(image, out, cv::COLOR_BGR2GRAY);
    } else {
      out = image;
    }
    if (format == kMono16) out.convertTo(out, CV_16U, 256.0);
    return out;
  }
  cv::Mat bgr = image;
  if (!color) cv::cvtColor(image, bgr, cv::COLOR_GRAY2BGR);
  if (format == kBgr) return bgr;
  if (format == kBayer) return mosaic(bgr);
  if (format == kRgb) cv::cvtColor(bgr, out, cv::COLOR_BGR2RGB);
  return out;
}

}  // namespace

class GigeServer::Impl {
 public:
  Impl(const GigeServerOptions& options, DrawFrame draw)
      : options_(options), draw_(std::move(draw)) {
    check(options_);
    const DescriptionFile file;
    camera_.reset(arv_fake_camera_new_full(options_.serial.c_str(), file.path()));
    powerUp();
    wire_ = std::make_unique<GigeWire>(options_.interface, camera_.get(), options_.packet_resend,
                                       [this] { serveRegisters(); });
    wire_->setLoss(options_.packet_loss);
    thread_ = std::thread(&Impl::run, this);
  }

  ~Impl() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      stop_ = true;
    }
    wake_.notify_all();
    thread_.join();
  }

  const GigeServerOptions& options() const { return options_; }
  GigeWire& wire() { return *wire_; }
  void setExposure(double us) {
    set(ARV_FAKE_CAMERA_REGISTER_EXPOSURE_TIME_US, static_cast<guint32>(std::lround(us)));
  }
  void setRegion(cv::Size size) {
    const auto side = [](int wanted, int most) {
      return static_cast<guint32>(std::clamp(wanted, 2, most));
    };
    set(ARV_FAKE_CAMERA_REGISTER_WIDTH, side(size.width, options_.size.width));
    set(ARV_FAKE_CAMERA_REGISTER_HEIGHT, side(size.height, options_.size.height));
  }
  void pulseLine0() { line0_ = true; }
  std::string problem() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return problem_;
  }

 private:
  void powerUp() {
    const auto name = [this](guint32 address, const char* text) {
      std::array<char, kNameBytes> padded{};
      std::strncpy(padded.data(), text, padded.size() - 1);
      arv_fake_camera_write_memory(camera_.get(), address, kNameBytes, padded.data());
    };
    name(kManufacturer, "OMNister");
    name(kModel, "Simulated");
    const auto width = static_cast<guint32>(options_.size.width);
    const auto height = static_cast<guint32>(options_.size.height);
    set(ARV_FAKE_CAMERA_REGISTER_SENSOR_WIDTH, width);
    set(ARV_FAKE_CAMERA_REGISTER_SENSOR_HEIGHT, height);
    set(ARV_FAKE_CAMERA_REGISTER_WIDTH, width);
    set(ARV_FAKE_CAMERA_REGISTER_HEIGHT, height);
    set(ARV_FAKE_CAMERA_REGISTER_PIXEL_FORMAT, options_.color ? kBgr : kMono8);
    set(ARV_FAKE_CAMERA_REGISTER_EXPOSURE_TIME_US,
        static_cast<guint32>(std::lround(options_.exposure_us)));
    set(kFramePeriod, static_cast<guint32>(std::lround(1e6 / options_.frame_rate_hz)));
    set(kTemperature, 4100);
    set(kPtpStatus, 3);
  }

  guint32 get(guint32 address) const {
    guint32 value = 0;
    arv_fake_camera_read_register(camera_.get(), address, &value);
    return value;
  }
  void set(guint32 address, guint32 value) {
    arv_fake_camera_write_register(camera_.get(), address, value);
  }

  bool streaming() const {
    return get(ARV_FAKE_CAMERA_REGISTER_ACQUISITION) != 0 && wire_->controlled();
  }

  /// The camera's clock at a time of the host's.
  std::uint64_t cameraClock(Stamp time) const {
    const std::int64_t host = time.time_since_epoch().count();
    return static_cast<std::uint64_t>(get(kPtpEnable) != 0 ? host : host - power_up_ + kClockAhead);
  }

  /// By the thread that serves clients.
  void serveRegisters() {
    if (get(kLatch) != 0) {
      set(kLatch, 0);
      const std::uint64_t clock = cameraClock(device::now());
      set(kLatchValue, static_cast<guint32>(clock >> 32));
      set(kLatchValue + 4, static_cast<guint32>(clock));
    }
    set(kPtpStatus, get(kPtpEnable) != 0 ? 9 : 3);
  }

  /// One tick. @return false at the end
  bool rest() {
    std::unique_lock<std::mutex> lock(mutex_);
    return !wake_.wait_for(lock, kTick, [this] { return stop_; });
  }

  bool triggered() {
    if (get(kTriggerSource) == 1) {
      if (get(kTriggerSoftware) == 0) return false;
      set(kTriggerSoftware, 0);
      return true;
    }
    return line0_.exchange(false);
  }

  void run() {
    Steady::time_point due = Steady::now();
    bool was_streaming = false;
    while (rest()) {
      if (!streaming()) {
        was_streaming = false;
        continue;
      }
      if (!was_streaming) {
        set(kTriggerSoftware, 0);
        line0_ = false;
        due = Steady::now();
        was_streaming = true;
      }
      if (get(kTriggerMode) != 0) {
        if (!triggered()) continue;
      } else {
        if (Steady::now() < due) continue;
        // A frame that could not be begun in time is not made up for.
        due = std::max(due, Steady::now() - milliseconds(10)) + microseconds(get(kFramePeriod));
      }
      expose();
    }
  }

  void expose() {
    const Stamp start = device::now();
    const microseconds exposure(get(ARV_FAKE_CAMERA_REGISTER_EXPOSURE_TIME_US));
    const Steady::time_point end = Steady::now() + exposure;
    while (Steady::now() < end) {
      if (!rest()) return;
    }
    try {
      cv::Mat image = draw_(start + exposure / 2);
      if (image.size() != options_.size || image.depth() != CV_8U ||
          (image.channels() != 1 && image.channels() != 3)) {
        throw Error("the drawn frame is not of the camera's size and type");
      }
      const cv::Size binned(
          std::max(1, image.cols / std::max(1, static_cast<int>(get(
                                                   ARV_FAKE_CAMERA_REGISTER_BINNING_HORIZONTAL)))),
          std::max(1, image.rows / std::max(1, static_cast<int>(get(
                                                   ARV_FAKE_CAMERA_REGISTER_BINNING_VERTICAL)))));
      if (binned != image.size()) cv::resize(image, image, binned, 0, 0, cv::INTER_AREA);
      wire_->send(toWire(image, start, exposure));
      const std::lock_guard<std::mutex> lock(mutex_);
      problem_.clear();
    } catch (const std::exception& e) {
      const std::lock_guard<std::mutex> lock(mutex_);
      problem_ = e.what();
    }
  }

  /// The region of the image that the registers name, in their pixel format.
  WireFrame toWire(const cv::Mat& drawn, Stamp start, microseconds exposure) const {
    WireFrame frame;
    frame.timestamp = cameraClock(start);
    frame.pixel_format = get(ARV_FAKE_CAMERA_REGISTER_PIXEL_FORMAT);
    frame.width = get(ARV_FAKE_CAMERA_REGISTER_WIDTH);
    frame.height = get(ARV_FAKE_CAMERA_REGISTER_HEIGHT);
    frame.x = get(ARV_FAKE_CAMERA_REGISTER_X_OFFSET);
    frame.y = get(ARV_FAKE_CAMERA_REGISTER_Y_OFFSET);
    const cv::Mat image = toPixelFormat(drawn, frame.pixel_format);
    if (image.empty()) throw Error("there is no such pixel format");
    const std::size_t row = frame.width * image.elemSize();
    frame.data.assign(row * frame.height, 0);
    const cv::Rect wanted(static_cast<int>(frame.x), static_cast<int>(frame.y),
                          static_cast<int>(frame.width), static_cast<int>(frame.height));
    const cv::Mat part = image(wanted & cv::Rect({0, 0}, image.size()));
    for (int y = 0; y < part.rows; ++y) {
      std::memcpy(frame.data.data() + static_cast<std::size_t>(y) * row, part.ptr(y),
                  static_cast<std::size_t>(part.cols) * part.elemSize());
    }
    frame.chunks = get(kChunkMode) != 0;
    if (!frame.chunks) return frame;
    const auto append = [&frame](std::uint64_t value, int bytes) {
      for (int i = bytes - 1; i >= 0; --i) {
        frame.data.push_back(static_cast<std::uint8_t>(value >> 8 * i));
      }
    };
    const auto close = [&append](Chunk chunk, std::size_t bytes) {
      append(chunk, kChunkTail / 2);
      append(bytes, kChunkTail / 2);
    };
    close(kImageChunk, frame.data.size());
    if (get(kChunkEnable) != 0) {
      const auto us = static_cast<double>(exposure.count());
      std::uint64_t bits = 0;
      std::memcpy(&bits, &us, sizeof bits);
      append(bits, kChunkBytes);
      close(kExposureChunk, kChunkBytes);
    }
    if (get(kChunkEnable + 4) != 0) {
      append(frame.timestamp, kChunkBytes);
      close(kTimestampChunk, kChunkBytes);
    }
    return frame;
  }

  const GigeServerOptions options_;
  const DrawFrame draw_;
  const std::int64_t power_up_ = device::now().time_since_epoch().count();
  struct Unref {
    void operator()(ArvFakeCamera* camera) const { g_object_unref(camera); }
  };
  std::unique_ptr<ArvFakeCamera, Unref> camera_;  // the registers
  std::unique_ptr<GigeWire> wire_;
  std::atomic<bool> line0_{false};
  mutable std::mutex mutex_;
  std::condition_variable wake_;
  bool stop_ = false;
  std::string problem_;
  std::thread thread_;
};

GigeServer::GigeServer(const GigeServerOptions& options, DrawFrame draw)
    : impl_(std::make_unique<Impl>(options, std::move(draw))) {}
GigeServer::~GigeServer() = default;
std::string GigeServer::device() const { return "aravis:" + impl_->options().serial; }
void GigeServer::setPacketLoss(double share) { impl_->wire().setLoss(share); }
void GigeServer::setExposure(double us) { impl_->setExposure(us); }
void GigeServer::setRegion(cv::Size size) { impl_->setRegion(size); }
void GigeServer::pulseLine0() { impl_->pulseLine0(); }
std::uint64_t GigeServer::framesSent() const { return impl_->wire().framesSent(); }
std::uint64_t GigeServer::packetsSentAgain() const { return impl_->wire().packetsSentAgain(); }
std::string GigeServer::problem() const { return impl_->problem(); }

}  // namespace omnister::sim
