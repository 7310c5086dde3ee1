// SPDX-License-Identifier: Apache-2.0
#include "omnister/common/image_file.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cctype>
#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <opencv2/imgcodecs.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/file_io.h"

namespace omnister {
namespace {

struct Header {
  std::uint64_t width = 0;
  std::uint64_t height = 0;
  bool complete = true;  ///< the file has its end
};

/// Integers out of a file; reading past the end gives zero, which no size may be.
class Bytes {
 public:
  Bytes(std::string_view data, bool little) : data_(data), little_(little) {}

  std::uint64_t at(std::size_t offset, int count) const {
    if (offset > data_.size() || data_.size() - offset < static_cast<std::size_t>(count)) return 0;
    std::uint64_t value = 0;
    for (int i = 0; i < count; ++i) {
      const auto byte = static_cast<unsigned char>(data_[offset + (little_ ? count - 1 - i : i)]);
      value = value << 8 | byte;
    }
    return value;
  }

 private:
  std::string_view data_;
  bool little_;
};

std::optional<Header> pngHeader(std::string_view data) {
  if (data.substr(0, 8) != std::string_view("\x89PNG\r\n\x1a\n", 8)) return std::nullopt;
  const Bytes bytes(data, false);
  return Header{bytes.at(16, 4), bytes.at(20, 4), data.rfind("IEND") != std::string_view::npos};
}

std::optional<Header> jpegHeader(std::string_view data) {
  if (data.substr(0, 3) != "\xFF\xD8\xFF") return std::nullopt;
  const Bytes bytes(data, false);
  Header header;
  std::size_t frame_offset = 0;
  // Segments up to the start of the frame, which carries the size.
  for (std::size_t offset = 2; bytes.at(offset, 1) == 0xFF;) {
    const auto marker = bytes.at(offset + 1, 1);
    if (marker == 0xFF) {
      ++offset;
      continue;
    }
    const bool frame =
        marker >= 0xC0 && marker <= 0xCF && marker != 0xC4 && marker != 0xC8 && marker != 0xCC;
    if (frame) {
      frame_offset = offset;
      header = {bytes.at(offset + 7, 2), bytes.at(offset + 5, 2), true};
      break;
    }
    offset += 2 + std::max<std::uint64_t>(bytes.at(offset + 2, 2), 2);
  }
  // Cameras append blocks after the end of the image, and put a thumbnail with an end of its own
  // before.
  const std::size_t end = data.rfind("\xFF\xD9");
  header.complete = end != std::string_view::npos && end > frame_offset;
  return header;
}

std::optional<Header> bmpHeader(std::string_view data) {
  if (data.substr(0, 2) != "BM" || data.size() < 26) return std::nullopt;
  const Bytes bytes(data, true);
  const auto height = static_cast<std::int32_t>(bytes.at(22, 4));
  return Header{bytes.at(18, 4), static_cast<std::uint64_t>(std::abs(std::int64_t{height}))};
}

std::optional<Header> pnmHeader(std::string_view data) {
  if (data.size() < 3 || data[0] != 'P' || data[1] < '1' || data[1] > '6') return std::nullopt;
  std::uint64_t numbers[2] = {0, 0};
  std::size_t i = 2;
  for (std::uint64_t& number : numbers) {
    while (i < data.size() &&
           (std::isspace(static_cast<unsigned char>(data[i])) || data[i] == '#')) {
      if (data[i] == '#')
        i = std::min(data.find('\n', i), data.size());
      else
        ++i;
    }
    for (; i < data.size() && data[i] >= '0' && data[i] <= '9' && number < (1u << 30); ++i) {
      number = 10 * number + (data[i] - '0');
    }
  }
  return Header{numbers[0], numbers[1]};
}

std::optional<Header> tiffHeader(std::string_view data) {
  const bool little = data.substr(0, 4) == std::string_view("II*\0", 4);
  if (!little && data.substr(0, 4) != std::string_view("MM\0*", 4)) return std::nullopt;
  const Bytes bytes(data, little);
  const auto directory = bytes.at(4, 4);
  const auto entries = bytes.at(directory, 2);
  Header header;
  for (std::uint64_t i = 0; i < entries; ++i) {
    const auto entry = directory + 2 + 12 * i;
    const auto tag = bytes.at(entry, 2);
    const auto value = bytes.at(entry + 8, bytes.at(entry + 2, 2) == 3 ? 2 : 4);
    if (tag == 256) header.width = value;
    if (tag == 257) header.height = value;
  }
  return header;
}

std::atomic<bool> decoders_are_silent{false};

/// What decoders say on standard error stays here while there is one of these, where that is asked
/// for. One at a time, so that it is known of which image they speak.
class SilentStandardError {
 public:
  SilentStandardError() {
    if (!decoders_are_silent) return;
    lock_ = std::unique_lock(mutex_);
    // What does not fit is lost.
    if (::pipe2(pipe_, O_CLOEXEC | O_NONBLOCK) != 0) return;
    saved_ = ::fcntl(STDERR_FILENO, F_DUPFD_CLOEXEC, STDERR_FILENO + 1);
    if (saved_ >= 0) ::dup2(pipe_[1], STDERR_FILENO);
  }
  ~SilentStandardError() {
    if (saved_ >= 0) ::dup2(saved_, STDERR_FILENO);
    for (const int fd : {saved_, pipe_[0], pipe_[1]})
      if (fd >= 0) ::close(fd);
  }
  SilentStandardError(const SilentStandardError&) = delete;
  SilentStandardError& operator=(const SilentStandardError&) = delete;

  /// What was said since.
  std::string said() const {
    std::string text(pipe_[0] < 0 ? 0 : 1 << 16, '\0');
    const ssize_t count = text.empty() ? 0 : ::read(pipe_[0], text.data(), text.size());
    text.resize(count > 0 ? static_cast<std::size_t>(count) : 0);
    return text;
  }

 private:
  static inline std::mutex mutex_;
  std::unique_lock<std::mutex> lock_;
  int pipe_[2] = {-1, -1};
  int saved_ = -1;
};

}  // namespace

void silenceDecoders() { decoders_are_silent = true; }

cv::Mat readImage(const std::filesystem::path& path, ImageColor color, std::size_t max_pixels) {
  const std::string data = readFile(path);
  const std::string name = path.string();
  if (data.empty()) throw InputError(name, "", "is empty, expected an image");
  std::optional<Header> header;
  for (const auto parse : {pngHeader, jpegHeader, tiffHeader, bmpHeader, pnmHeader}) {
    if (!header) header = parse(data);
  }
  if (!header)
    throw InputError(name, "", "is not an image, expected PNG, JPEG, TIFF, BMP, PGM or PPM");
  if (header->width == 0 || header->height == 0) {
    throw InputError(name, "", "has a damaged header: no image size in it");
  }
  const std::string size = std::to_string(header->width) + "x" + std::to_string(header->height);
  if (header->width > max_pixels / header->height) {
    throw InputError(name, "",
                     "is " + size + " pixels, expected at most " + std::to_string(max_pixels));
  }
  if (!header->complete) throw InputError(name, "", "is cut off: the end of the image is missing");
  int flags = cv::IMREAD_ANYDEPTH | cv::IMREAD_IGNORE_ORIENTATION;
  if (color == ImageColor::kColor) flags |= cv::IMREAD_COLOR;
  if (color == ImageColor::kAsIs) flags = cv::IMREAD_UNCHANGED;
  cv::Mat image;
  bool cut_off = false;
  try {
    const SilentStandardError silence;
    image = cv::imdecode(
        cv::Mat(1, static_cast<int>(data.size()), CV_8UC1, const_cast<char*>(data.data())), flags);
    // Where a JPEG ends too soon its decoder fills up with grey, and calls that a success.
    cut_off = silence.said().find("remature end of ") != std::string::npos;
  } catch (const cv::Exception& error) {
    throw InputError(name, "", "cannot be decoded: " + error.err);
  }
  if (image.empty() || cut_off)
    throw InputError(name, "", "cannot be decoded: the image data is damaged");
  return image;
}

void checkImagePath(const std::filesystem::path& path) {
  std::string extension = path.extension().string();
  for (char& c : extension) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  for (const char* known : {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm"}) {
    if (extension == known) return;
  }
  throw InputError(path.string(), "",
                   "has no extension of an image, expected .png, .jpg, .tif, .bmp, .pgm or .ppm");
}

std::unique_ptr<AtomicFile> stageImage(const std::filesystem::path& path, const cv::Mat& image) {
  checkImagePath(path);
  std::vector<uchar> bytes;
  bool encoded = false;
  try {
    encoded = cv::imencode(path.extension().string(), image, bytes);
  } catch (const cv::Exception&) {
    encoded = false;
  }
  if (!encoded) throw InputError(path.string(), "", "cannot hold this image");
  auto file = std::make_unique<AtomicFile>(path);
  file->write({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  return file;
}

void writeImage(const std::filesystem::path& path, const cv::Mat& image) {
  stageImage(path, image)->commit();
}

}  // namespace omnister
