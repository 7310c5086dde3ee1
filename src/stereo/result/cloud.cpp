// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/cloud.h"

#include <algorithm>
#include <cctype>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <cstring>
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

// A row of points: place, colour as `put_color` writes it, sigma and score.
template <typename PutColor>
void putRow(const Cloud& cloud, int row, char* out, const PutColor& put_color) {
  const auto* xyz = cloud.xyz.ptr<cv::Vec3f>(row);
  const auto* bgr = cloud.bgr.ptr<cv::Vec3b>(row);
  const auto* sigma = cloud.sigma.ptr<float>(row);
  const auto* score = cloud.score.ptr<float>(row);
  for (int u = 0; u < cloud.xyz.cols; ++u) {
    for (int i = 0; i < 3; ++i) out = put(out, xyz[u][i]);
    out = put_color(out, bgr[u]);
    out = put(out, sigma[u]);
    out = put(out, score[u]);
  }
}

void putPlyRow(const Cloud& cloud, int row, char* out) {
  putRow(cloud, row, out, [](char* at, const cv::Vec3b& bgr) {
    for (int i = 2; i >= 0; --i) at = put(at, bgr[i]);
    return at;
  });
}

void putPcdRow(const Cloud& cloud, int row, char* out) {
  // PCL packs the colour into the bits of one float.
  putRow(cloud, row, out, [](char* at, const cv::Vec3b& bgr) {
    return put(at, static_cast<std::uint32_t>(bgr[2] << 16 | bgr[1] << 8 | bgr[0]));
  });
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

namespace {

// Shared by both ways to get the rays: `raysOf(v, scratch)` gives those of a row.
template <typename Scratch, typename RaysOf>
Cloud cloudOf(const MatchResult& match, const cv::Mat& image, int threads, const RaysOf& raysOf) {
  const cv::Size size = match.range.size();
  if (image.size() != size || (image.type() != CV_8UC1 && image.type() != CV_8UC3)) {
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
  // Blocks of rows, so that scratch memory is not asked for row by row.
  constexpr int kBlock = 16;
  const std::size_t blocks = (size.height + kBlock - 1) / kBlock;
  parallelFor(0, blocks, threads, [&](std::size_t block) {
    Scratch scratch;
    const int end = std::min(static_cast<int>(block + 1) * kBlock, size.height);
    for (int v = static_cast<int>(block) * kBlock; v < end; ++v) {
      const auto* range = match.range.ptr<float>(v);
      auto* xyz = cloud.xyz.ptr<cv::Vec3f>(v);
      const cv::Vec3f* ray = raysOf(v, scratch, xyz);
      for (int u = 0; u < size.width; ++u) {
        const float r = range[u];
        // NaN and infinity alike fail the comparison.
        const float valid = std::abs(r) <= std::numeric_limits<float>::max() ? r : kNan;
        xyz[u] = cv::Vec3f(valid * ray[u][0], valid * ray[u][1], valid * ray[u][2]);
      }
      if (grey) {
        const auto* from = image.ptr<uchar>(v);
        auto* to = cloud.bgr.ptr<cv::Vec3b>(v);
        for (int u = 0; u < size.width; ++u) to[u] = cv::Vec3b(from[u], from[u], from[u]);
      }
    }
  });
  return cloud;
}

cv::Vec3f rayOf(const LensModel& lens, double u, double v) {
  const auto ray = lens.unproject({u, v});
  if (!ray) return {kNan, kNan, kNan};
  return {static_cast<float>(ray->x()), static_cast<float>(ray->y()), static_cast<float>(ray->z())};
}

constexpr int kCell = 8;

// The cubic through the nodes at -1, 0, 1 and 2.
void cubicWeights(float t, float* weights) {
  weights[0] = -t * (t - 1.0f) * (t - 2.0f) / 6.0f;
  weights[1] = (t + 1.0f) * (t - 1.0f) * (t - 2.0f) / 2.0f;
  weights[2] = -(t + 1.0f) * t * (t - 2.0f) / 2.0f;
  weights[3] = (t + 1.0f) * t * (t - 1.0f) / 6.0f;
}

struct CellWeights {
  CellWeights() {
    for (int i = 0; i < kCell; ++i) cubicWeights(static_cast<float>(i) / kCell, weights[i]);
  }
  float weights[kCell][4];
};
const CellWeights kCellWeights;

}  // namespace

Cloud makeCloud(const MatchResult& match, const cv::Mat& rays, const cv::Mat& image, int threads) {
  if (rays.size() != match.range.size() || rays.type() != CV_32FC3) {
    throw Error("range and rays of a cloud differ in size");
  }
  struct None {};
  return cloudOf<None>(match, image, threads,
                       [&](int v, None&, cv::Vec3f*) { return rays.ptr<cv::Vec3f>(v); });
}

Cloud makeCloud(const MatchResult& match, const LensModel& lens, const cv::Mat& image) {
  return makeCloud(match, viewingRays(lens, match.range.size()), image);
}

PointMaker::PointMaker(const LensModel& lens, cv::Size size, int threads)
    : size_(size),
      cells_((size.width + kCell - 1) / kCell, (size.height + kCell - 1) / kCell),
      nodes_(cells_.height + 3, cells_.width + 3, CV_32FC3),
      exact_offset_(cells_.area(), -1) {
  parallelFor(0, static_cast<std::size_t>(nodes_.rows), threads, [&](std::size_t j) {
    auto* row = nodes_.ptr<cv::Vec3f>(static_cast<int>(j));
    for (int i = 0; i < nodes_.cols; ++i) {
      row[i] = rayOf(lens, (i - 1.0) * kCell, (static_cast<double>(j) - 1.0) * kCell);
    }
  });
  // A cell is interpolated where that is right in its middle, where a cubic is furthest off; NaN
  // fails.
  std::vector<char> interpolated(cells_.area());
  parallelFor(0, static_cast<std::size_t>(cells_.height), threads, [&](std::size_t row) {
    const int j = static_cast<int>(row);
    const float* middle = kCellWeights.weights[kCell / 2];
    for (int i = 0; i < cells_.width; ++i) {
      cv::Vec3f ray(0.0f, 0.0f, 0.0f);
      for (int k = 0; k < 16; ++k) {
        ray += middle[k / 4] * middle[k % 4] * nodes_.at<cv::Vec3f>(j + k / 4, i + k % 4);
      }
      const cv::Vec3f truth = rayOf(lens, (i + 0.5) * kCell, (j + 0.5) * kCell);
      interpolated[j * cells_.width + i] = cv::norm(ray - truth) < 5e-7;
    }
  });
  std::vector<int> edge;
  for (int cell = 0; cell < cells_.area(); ++cell) {
    if (interpolated[cell] != 0) continue;
    exact_offset_[cell] = static_cast<int>(edge.size()) * kCell * kCell;
    edge.push_back(cell);
  }
  exact_.resize(edge.size() * kCell * kCell);
  parallelFor(0, edge.size(), threads, [&](std::size_t k) {
    const int u0 = edge[k] % cells_.width * kCell, v0 = edge[k] / cells_.width * kCell;
    for (int i = 0; i < kCell * kCell; ++i) {
      const int u = u0 + i % kCell, v = v0 + i / kCell;
      exact_[k * kCell * kCell + i] = rayOf(lens, u, v);
    }
  });
}

void PointMaker::row(int v, std::vector<cv::Vec3f>& nodes, cv::Vec3f* rays) const {
  const int j = v / kCell;
  const float* down = kCellWeights.weights[v % kCell];
  nodes.resize(nodes_.cols);
  const cv::Vec3f* node_rows[4];
  for (int k = 0; k < 4; ++k) node_rows[k] = nodes_.ptr<cv::Vec3f>(j + k);
  for (int i = 0; i < nodes_.cols; ++i) {
    for (int c = 0; c < 3; ++c) {
      nodes[i][c] = down[0] * node_rows[0][i][c] + down[1] * node_rows[1][i][c] +
                    down[2] * node_rows[2][i][c] + down[3] * node_rows[3][i][c];
    }
  }
  for (int i = 0; i < cells_.width; ++i) {
    const int width = std::min(kCell, size_.width - i * kCell);
    cv::Vec3f* out = rays + i * kCell;
    const int offset = exact_offset_[j * cells_.width + i];
    if (offset >= 0) {
      std::copy_n(exact_.begin() + offset + v % kCell * kCell, width, out);
      continue;
    }
    for (int u = 0; u < width; ++u) {
      const float* across = kCellWeights.weights[u];
      for (int c = 0; c < 3; ++c) {
        out[u][c] = across[0] * nodes[i][c] + across[1] * nodes[i + 1][c] +
                    across[2] * nodes[i + 2][c] + across[3] * nodes[i + 3][c];
      }
    }
  }
}

Cloud PointMaker::make(const MatchResult& match, const cv::Mat& image, int threads) const {
  if (match.range.size() != size_) throw Error("range and lens of a cloud differ in size");
  // The rays of a row are written where its points will be.
  return cloudOf<std::vector<cv::Vec3f>>(match, image, threads,
                                         [&](int v, std::vector<cv::Vec3f>& nodes, cv::Vec3f* xyz) {
                                           row(v, nodes, xyz);
                                           return xyz;
                                         });
}

std::size_t PointMaker::countField(const cv::Mat& mask) const {
  std::size_t count = 0;
  std::vector<cv::Vec3f> nodes, rays(size_.width);
  for (int v = 0; v < size_.height; ++v) {
    row(v, nodes, rays.data());
    for (int u = 0; u < size_.width; ++u) {
      count += !std::isnan(rays[u][0]) && (mask.empty() || mask.at<uchar>(v, u) != 0);
    }
  }
  return count;
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
  const cv::Size size = cloud.xyz.size();
  file->write(ply ? plyHeader(size) : pcdHeader(size));
  std::string row(size.width * (ply ? kPlyVertexBytes : kPcdPointBytes), '\0');
  for (int v = 0; v < size.height; ++v) {
    (ply ? putPlyRow : putPcdRow)(cloud, v, row.data());
    file->write(row);
  }
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
  file->write({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  return file;
}

void writeCloud(const fs::path& path, const Cloud& cloud) { stageCloud(path, cloud)->commit(); }

void writeRange(const fs::path& path, const cv::Mat& range) { stageRange(path, range)->commit(); }

Cloud readCloud(const fs::path& path) {
  return parseCloud(readFile(path, std::size_t{4} << 30), path.string());
}

Cloud parseCloud(std::string_view bytes, const std::string& source) {
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
