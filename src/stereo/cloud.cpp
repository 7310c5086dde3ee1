// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/cloud.h"

#include <algorithm>
#include <cctype>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <limits>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <string>
#include <string_view>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "the files are little-endian");

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
// x y z (float), red green blue (uchar), sigma score (float), packed.
constexpr std::size_t kPlyVertexBytes = 3 * 4 + 3 + 2 * 4;
// x y z rgb sigma score (float).
constexpr std::size_t kPcdPointBytes = 6 * 4;
constexpr int kMaxSide = 65535;

constexpr std::string_view kPlyProperties =
    "property float x\n"
    "property float y\n"
    "property float z\n"
    "property uchar red\n"
    "property uchar green\n"
    "property uchar blue\n"
    "property float sigma\n"
    "property float score\n"
    "end_header\n";

std::string extensionOf(const fs::path& path) {
  std::string extension = path.extension().string();
  std::transform(extension.begin(), extension.end(), extension.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return extension;
}

void checkCloud(const Cloud& cloud) {
  const cv::Size size = cloud.xyz.size();
  if (cloud.xyz.type() != CV_32FC3 || cloud.bgr.type() != CV_8UC3 || cloud.bgr.size() != size ||
      cloud.sigma.type() != CV_32FC1 || cloud.sigma.size() != size ||
      cloud.score.type() != CV_32FC1 || cloud.score.size() != size) {
    throw Error("images of a cloud are of different size or of the wrong type");
  }
}

std::string plyHeader(cv::Size size) {
  return "ply\nformat binary_little_endian 1.0\ncomment width " + std::to_string(size.width) +
         "\ncomment height " + std::to_string(size.height) + "\nelement vertex " +
         std::to_string(static_cast<std::size_t>(size.width) * size.height) + "\n" +
         std::string(kPlyProperties);
}

std::string pcdHeader(cv::Size size) {
  return "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
         "FIELDS x y z rgb sigma score\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\nCOUNT 1 1 1 1 1 1\n"
         "WIDTH " +
         std::to_string(size.width) + "\nHEIGHT " + std::to_string(size.height) +
         "\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS " +
         std::to_string(static_cast<std::size_t>(size.width) * size.height) + "\nDATA binary\n";
}

template <typename T>
char* put(char* out, const T& value) {
  std::memcpy(out, &value, sizeof value);
  return out + sizeof value;
}

template <typename T>
const char* take(const char* in, T& value) {
  std::memcpy(&value, in, sizeof value);
  return in + sizeof value;
}

void putPlyRow(const Cloud& cloud, int row, char* out) {
  const auto* xyz = cloud.xyz.ptr<cv::Vec3f>(row);
  const auto* bgr = cloud.bgr.ptr<cv::Vec3b>(row);
  const auto* sigma = cloud.sigma.ptr<float>(row);
  const auto* score = cloud.score.ptr<float>(row);
  for (int u = 0; u < cloud.xyz.cols; ++u) {
    for (int i = 0; i < 3; ++i) out = put(out, xyz[u][i]);
    for (int i = 2; i >= 0; --i) out = put(out, bgr[u][i]);
    out = put(out, sigma[u]);
    out = put(out, score[u]);
  }
}

void putPcdRow(const Cloud& cloud, int row, char* out) {
  const auto* xyz = cloud.xyz.ptr<cv::Vec3f>(row);
  const auto* bgr = cloud.bgr.ptr<cv::Vec3b>(row);
  const auto* sigma = cloud.sigma.ptr<float>(row);
  const auto* score = cloud.score.ptr<float>(row);
  for (int u = 0; u < cloud.xyz.cols; ++u) {
    for (int i = 0; i < 3; ++i) out = put(out, xyz[u][i]);
    // PCL packs the colour into the bits of one float.
    out = put(out, static_cast<std::uint32_t>(bgr[u][2] << 16 | bgr[u][1] << 8 | bgr[u][0]));
    out = put(out, sigma[u]);
    out = put(out, score[u]);
  }
}

// Lines of the header of a PLY, with messages that name them.
class HeaderReader {
 public:
  HeaderReader(std::string_view bytes, std::string source)
      : bytes_(bytes), source_(std::move(source)) {}

  void expect(std::string_view line) {
    const std::string_view found = next();
    if (found != line)
      fail("is '" + printable(found, 60) + "', expected '" + std::string(line) + "'");
  }

  // A line of `prefix` and a number from 1 to `most`.
  std::size_t expectCount(std::string_view prefix, std::size_t most) {
    const std::string_view found = next();
    std::size_t value = 0;
    bool good = found.size() > prefix.size() && found.substr(0, prefix.size()) == prefix;
    for (std::size_t i = prefix.size(); good && i < found.size(); ++i) {
      good = found[i] >= '0' && found[i] <= '9';
      value = value * 10 + static_cast<std::size_t>(found[i] - '0');
      good = good && value <= most;
    }
    if (!good || value == 0) {
      fail("is '" + printable(found, 60) + "', expected '" + std::string(prefix) +
           "N' with N from 1 to " + std::to_string(most));
    }
    return value;
  }

  std::size_t offset() const { return offset_; }

 private:
  std::string_view next() {
    ++line_;
    const std::size_t end = bytes_.substr(0, offset_ + 256).find('\n', offset_);
    if (end == std::string_view::npos) fail("is missing or longer than 256 characters");
    const std::string_view line = bytes_.substr(offset_, end - offset_);
    offset_ = end + 1;
    return line;
  }

  [[noreturn]] void fail(const std::string& problem) const {
    throw InputError(source_, "line " + std::to_string(line_), problem);
  }

  std::string_view bytes_;
  std::string source_;
  std::size_t offset_ = 0;
  int line_ = 0;
};

}  // namespace

cv::Mat viewingRays(const LensModel& lens, cv::Size size, int threads) {
  cv::Mat rays(size, CV_32FC3);
  parallelFor(0, static_cast<std::size_t>(size.height), threads, [&](std::size_t v) {
    auto* row = rays.ptr<cv::Vec3f>(static_cast<int>(v));
    for (int u = 0; u < size.width; ++u) {
      const auto ray = lens.unproject({u, static_cast<double>(v)});
      row[u] = ray ? cv::Vec3f(static_cast<float>(ray->x()), static_cast<float>(ray->y()),
                               static_cast<float>(ray->z()))
                   : cv::Vec3f(kNan, kNan, kNan);
    }
  });
  return rays;
}

Cloud makeCloud(const MatchResult& match, const cv::Mat& rays, const cv::Mat& image, int threads) {
  const cv::Size size = match.range.size();
  if (rays.size() != size || rays.type() != CV_32FC3 || image.size() != size ||
      (image.type() != CV_8UC1 && image.type() != CV_8UC3)) {
    throw Error(
        "range, rays and image of a cloud differ in size, or the image is not 8-bit grey or BGR");
  }
  Cloud cloud;
  cloud.sigma = match.sigma;
  cloud.score = match.score;
  cloud.xyz.create(size, CV_32FC3);
  const bool grey = image.channels() == 1;
  if (grey) {
    cloud.bgr.create(size, CV_8UC3);
  } else {
    cloud.bgr = image;
  }
  parallelFor(0, static_cast<std::size_t>(size.height), threads, [&](std::size_t row) {
    const int v = static_cast<int>(row);
    const auto* range = match.range.ptr<float>(v);
    const auto* ray = rays.ptr<cv::Vec3f>(v);
    auto* xyz = cloud.xyz.ptr<cv::Vec3f>(v);
    for (int u = 0; u < size.width; ++u) {
      xyz[u] = std::isfinite(range[u]) ? range[u] * ray[u] : cv::Vec3f(kNan, kNan, kNan);
    }
    if (grey) {
      const auto* from = image.ptr<uchar>(v);
      auto* to = cloud.bgr.ptr<cv::Vec3b>(v);
      for (int u = 0; u < size.width; ++u) to[u] = cv::Vec3b::all(from[u]);
    }
  });
  return cloud;
}

Cloud makeCloud(const MatchResult& match, const LensModel& lens, const cv::Mat& image) {
  return makeCloud(match, viewingRays(lens, match.range.size()), image);
}

void checkCloudPath(const fs::path& path) {
  const std::string extension = extensionOf(path);
  if (extension != ".ply" && extension != ".pcd") {
    throw InputError(path.string(), "", "has no extension of a cloud, expected .ply or .pcd");
  }
}

void checkRangePath(const fs::path& path) {
  const std::string extension = extensionOf(path);
  if (extension != ".tif" && extension != ".tiff") {
    throw InputError(path.string(), "",
                     "has no extension of a range image, expected .tif or .tiff");
  }
}

std::unique_ptr<AtomicFile> stageCloud(const fs::path& path, const Cloud& cloud) {
  checkCloudPath(path);
  checkCloud(cloud);
  const bool ply = extensionOf(path) == ".ply";
  auto file = std::make_unique<AtomicFile>(path);
  errno = 0;
  std::ofstream stream(file->path(), std::ios::binary);
  const cv::Size size = cloud.xyz.size();
  const std::string header = ply ? plyHeader(size) : pcdHeader(size);
  stream.write(header.data(), static_cast<std::streamsize>(header.size()));
  std::vector<char> row(size.width * (ply ? kPlyVertexBytes : kPcdPointBytes));
  for (int v = 0; v < size.height && stream; ++v) {
    (ply ? putPlyRow : putPcdRow)(cloud, v, row.data());
    stream.write(row.data(), static_cast<std::streamsize>(row.size()));
  }
  stream.close();
  if (!stream) throw IoError("write", path.string(), errno != 0 ? errno : EIO);
  return file;
}

std::unique_ptr<AtomicFile> stageRange(const fs::path& path, const cv::Mat& range) {
  checkRangePath(path);
  if (range.type() != CV_32FC1 || range.empty()) {
    throw Error("a range image is not one channel of 32-bit floats");
  }
  // Encoded in memory: libtiff complains on standard error when it cannot open a file itself.
  std::vector<uchar> bytes;
  if (!cv::imencode(".tiff", range, bytes)) throw IoError("encode", path.string(), EIO);
  auto file = std::make_unique<AtomicFile>(path);
  errno = 0;
  std::ofstream stream(file->path(), std::ios::binary);
  stream.write(reinterpret_cast<const char*>(bytes.data()),
               static_cast<std::streamsize>(bytes.size()));
  stream.close();
  if (!stream) throw IoError("write", path.string(), errno != 0 ? errno : EIO);
  return file;
}

void writeCloud(const fs::path& path, const Cloud& cloud) { stageCloud(path, cloud)->commit(); }

void writeRange(const fs::path& path, const cv::Mat& range) { stageRange(path, range)->commit(); }

Cloud readCloud(const fs::path& path) {
  const std::string bytes = readFile(path, std::size_t{4} << 30);
  const std::string source = path.string();
  HeaderReader header(bytes, source);
  header.expect("ply");
  header.expect("format binary_little_endian 1.0");
  const int width = static_cast<int>(header.expectCount("comment width ", kMaxSide));
  const int height = static_cast<int>(header.expectCount("comment height ", kMaxSide));
  const std::size_t points = static_cast<std::size_t>(width) * height;
  if (header.expectCount("element vertex ", std::size_t{kMaxSide} * kMaxSide) != points) {
    throw InputError(source, "line 5", "does not count width x height vertices");
  }
  std::string_view properties = kPlyProperties;
  while (!properties.empty()) {
    const std::size_t end = properties.find('\n');
    header.expect(properties.substr(0, end));
    properties.remove_prefix(end + 1);
  }
  if (bytes.size() - header.offset() != points * kPlyVertexBytes) {
    throw InputError(source, "",
                     "has " + std::to_string(bytes.size() - header.offset()) +
                         " bytes of vertices, expected " +
                         std::to_string(points * kPlyVertexBytes));
  }
  Cloud cloud{cv::Mat(height, width, CV_32FC3), cv::Mat(height, width, CV_8UC3),
              cv::Mat(height, width, CV_32FC1), cv::Mat(height, width, CV_32FC1)};
  const char* in = bytes.data() + header.offset();
  for (int v = 0; v < height; ++v) {
    for (int u = 0; u < width; ++u) {
      auto& xyz = cloud.xyz.at<cv::Vec3f>(v, u);
      for (int i = 0; i < 3; ++i) in = take(in, xyz[i]);
      auto& bgr = cloud.bgr.at<cv::Vec3b>(v, u);
      for (int i = 2; i >= 0; --i) in = take(in, bgr[i]);
      in = take(in, cloud.sigma.at<float>(v, u));
      in = take(in, cloud.score.at<float>(v, u));
      const bool none = std::isnan(xyz[0]) && std::isnan(xyz[1]) && std::isnan(xyz[2]);
      const bool all = std::isfinite(xyz[0]) && std::isfinite(xyz[1]) && std::isfinite(xyz[2]);
      if (!none && !all) {
        throw InputError(source, "vertex (" + std::to_string(u) + ", " + std::to_string(v) + ")",
                         "is neither finite nor all nan");
      }
    }
  }
  return cloud;
}

}  // namespace omnister
