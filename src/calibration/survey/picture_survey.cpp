// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/picture_survey.h"

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <cstdint>
#include <exception>
#include <filesystem>
#include <map>
#include <opencv2/imgproc.hpp>
#include <optional>
#include <utility>

#include "calibration/detect/corner_refinement.h"
#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/common/parallel.h"
#include "omnister/common/text.h"

namespace omnister {
namespace {

namespace fs = std::filesystem;

bool isPicture(const fs::path& path) {
  std::string extension = path.extension().string();
  for (char& c : extension) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  for (const char* known : {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm"}) {
    if (extension == known) return true;
  }
  return false;
}

/// 2.png before 10.png: runs of digits compare as numbers.
bool naturalOrder(const std::string& a, const std::string& b) {
  const auto digit = [](char c) { return std::isdigit(static_cast<unsigned char>(c)) != 0; };
  std::size_t i = 0;
  std::size_t j = 0;
  while (i < a.size() && j < b.size()) {
    if (digit(a[i]) && digit(b[j])) {
      std::size_t end_a = i;
      std::size_t end_b = j;
      while (end_a < a.size() && digit(a[end_a])) ++end_a;
      while (end_b < b.size() && digit(b[end_b])) ++end_b;
      std::size_t from_a = i;
      std::size_t from_b = j;
      while (from_a + 1 < end_a && a[from_a] == '0') ++from_a;
      while (from_b + 1 < end_b && b[from_b] == '0') ++from_b;
      if (end_a - from_a != end_b - from_b) return end_a - from_a < end_b - from_b;
      const int order = a.compare(from_a, end_a - from_a, b, from_b, end_b - from_b);
      if (order != 0) return order < 0;
      i = end_a;
      j = end_b;
      continue;
    }
    if (a[i] != b[j]) return a[i] < b[j];
    ++i;
    ++j;
  }
  return a.size() - i < b.size() - j || (a.size() - i == b.size() - j && a < b);
}

std::uint64_t hashOf(const cv::Mat& image) {
  std::uint64_t hash = 0xcbf29ce484222325ull;  // FNV-1a
  const auto take = [&](const uchar* bytes, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) hash = (hash ^ bytes[i]) * 0x100000001b3ull;
  };
  for (int row = 0; row < image.rows; ++row) {
    take(image.ptr(row), static_cast<std::size_t>(image.cols) * image.elemSize());
  }
  return hash;
}

/// What can be told without a board.
struct Look {
  bool read = false;
  std::exception_ptr failure;
  std::string problem;
  cv::Size size;
  std::uint64_t hash = 0;
  double sharpness = 0.0;  ///< spread of the second derivative over that of the grey levels
  double dark = 0.0;       ///< level that all but one in 200 pixels stay below, of 255
  double bright = 0.0;     ///< level that half of all pixels exceed
  double spread = 0.0;     ///< standard deviation of the grey levels
};

Look lookAt(const std::string& file) {
  Look look;
  try {
    const cv::Mat image = readImage(file, ImageColor::kGray);
    look.read = true;
    look.size = image.size();
    look.hash = hashOf(image);
    cv::Mat gray = image;
    // Deep pictures need not use all of their bits: their own range tells nothing of exposure.
    if (gray.depth() != CV_8U) gray = detect::toGray(image).eight_bit;
    cv::Mat second;
    cv::Laplacian(gray, second, CV_32F);
    cv::Scalar mean, deviation, ignored, spread;
    cv::meanStdDev(second, mean, deviation);
    cv::meanStdDev(gray, ignored, spread);
    look.spread = spread[0];
    look.sharpness = deviation[0] / std::max(1.0, spread[0]);
    std::array<std::size_t, 256> counts{};
    for (int row = 0; row < gray.rows; ++row) {
      for (int col = 0; col < gray.cols; ++col) ++counts[gray.at<uchar>(row, col)];
    }
    const auto level = [&](double share) {
      double left = share * static_cast<double>(gray.total());
      int value = 0;
      while (value < 255 &&
             (left -= static_cast<double>(counts[static_cast<std::size_t>(value)])) > 0) {
        ++value;
      }
      return static_cast<double>(value);
    };
    look.dark = level(0.995);
    look.bright = level(0.5);
  } catch (const Error& error) {
    look.failure = std::current_exception();
    look.problem = error.what();
    // The name stands before the reason already.
    if (look.problem.rfind(file, 0) == 0) {
      look.problem = look.problem.substr(std::min(look.problem.size(), file.size() + 2));
    }
  }
  return look;
}

/// Of two copies the one that was there first is kept.
bool isOlder(const std::string& a, const std::string& b) {
  std::error_code no_a, no_b;
  const auto time_a = fs::last_write_time(a, no_a);
  const auto time_b = fs::last_write_time(b, no_b);
  return !no_a && !no_b && time_a < time_b;
}

std::string textOf(const cv::Size& size) {
  return std::to_string(size.width) + "x" + std::to_string(size.height);
}

double medianOf(std::vector<double> values) {
  if (values.empty()) return std::nan("");
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

std::string doubtOf(const Look& look, double typical_sharpness) {
  if (look.dark < 40.0) return "is too dark";
  if (look.bright > 240.0) return "is too bright";
  if (look.spread < 8.0) return "has hardly any contrast";
  if (look.sharpness < 0.35 * typical_sharpness) return "is blurred";
  return "";
}

/// Neighbours on the board with one plain edge between them: corners of one tag, of one square.
std::vector<std::pair<int, int>> edgesOf(const Target& target) {
  const Eigen::Vector2i grid = targetGrid(target);
  std::vector<std::pair<int, int>> edges;
  for (int row = 0; row < grid.y(); ++row) {
    for (int col = 0; col < grid.x(); ++col) {
      const int id = row * grid.x() + col;
      const bool tags = target.type == TargetType::kAprilGrid;
      if (col + 1 < grid.x() && (!tags || col % 2 == 0)) edges.emplace_back(id, id + 1);
      if (row + 1 < grid.y() && (!tags || row % 2 == 0)) edges.emplace_back(id, id + grid.x());
    }
  }
  return edges;
}

/// Contrast over steepest slope along a line [px].
std::optional<double> widthAlong(const cv::Mat& fine, const Eigen::Vector2d& from,
                                 const Eigen::Vector2d& to) {
  const double length = (to - from).norm();
  const int steps = static_cast<int>(length / 0.5);
  if (steps < 8) return std::nullopt;
  std::vector<double> levels;
  for (int i = 0; i <= steps; ++i) {
    const auto gray = detect::grayAt(fine, from + (to - from) * (static_cast<double>(i) / steps));
    if (!gray) return std::nullopt;
    levels.push_back(*gray);
  }
  const auto mean = [&](std::size_t begin, std::size_t count) {
    double sum = 0.0;
    for (std::size_t i = begin; i < begin + count; ++i) sum += levels[i];
    return sum / static_cast<double>(count);
  };
  const std::size_t end = std::max<std::size_t>(2, levels.size() / 6);
  const double contrast = std::abs(mean(levels.size() - end, end) - mean(0, end));
  if (contrast < 12.0) return std::nullopt;
  double steepest = 0.0;
  for (std::size_t i = 2; i < levels.size(); ++i) {
    steepest = std::max(steepest, std::abs(levels[i] - levels[i - 2]));
  }
  return contrast / (steepest * steps / (2.0 * length));
}

}  // namespace

std::vector<std::string> picturesIn(const std::vector<std::string>& files_and_folders) {
  std::vector<std::string> images;
  for (const std::string& name : files_and_folders) {
    std::error_code ignored;
    if (!fs::is_directory(name, ignored)) {
      images.push_back(name);
      continue;
    }
    std::vector<std::string> found;
    std::error_code error;
    for (fs::directory_iterator entry(name, error), end; !error && entry != end;
         entry.increment(error)) {
      std::error_code broken;
      if (isPicture(entry->path()) && !entry->is_directory(broken)) {
        found.push_back(entry->path().string());
      }
    }
    if (error) throw IoError("read", name, error.value());
    if (found.empty()) {
      throw InputError(name, "", "has no picture in it, expected PNG, JPEG, TIFF, BMP, PGM or PPM");
    }
    std::sort(found.begin(), found.end(), naturalOrder);
    images.insert(images.end(), found.begin(), found.end());
  }
  return images;
}

PictureSurvey surveyPictures(const std::vector<std::string>& images, int threads) {
  std::vector<Look> looks(images.size());
  parallelFor(0, images.size(), threads, [&](std::size_t i) { looks[i] = lookAt(images[i]); });
  std::map<std::pair<int, int>, std::size_t> sizes;
  std::size_t read = 0;
  std::vector<double> sharpness;
  for (const Look& look : looks) {
    if (!look.read) continue;
    ++read;
    ++sizes[{look.size.width, look.size.height}];
    sharpness.push_back(look.sharpness);
  }
  if (read == 0 && !looks.empty()) std::rethrow_exception(looks.front().failure);
  cv::Size common;
  for (const auto& [size, count] : sizes) {
    if (count >= 3 && 2 * count > read) common = {size.first, size.second};
  }
  const double typical = medianOf(sharpness);
  PictureSurvey survey;
  std::map<std::uint64_t, std::size_t> original;
  for (std::size_t i = 0; i < images.size(); ++i) {
    if (!looks[i].read || (common.area() > 0 && looks[i].size != common)) continue;
    const auto [first, fresh] = original.emplace(looks[i].hash, i);
    if (!fresh && isOlder(images[i], images[first->second])) first->second = i;
  }
  for (std::size_t i = 0; i < images.size(); ++i) {
    const Look& look = looks[i];
    std::string reason;
    if (!look.read) {
      reason = look.problem;
    } else if (common.area() > 0 && look.size != common) {
      reason = "is " + textOf(look.size) + " pixels, most are " + textOf(common);
      if (look.size == cv::Size(common.height, common.width)) reason += ": it was turned";
    } else if (original.at(look.hash) != i) {
      reason = "is the same picture as " + images[original.at(look.hash)];
    }
    if (!reason.empty()) {
      survey.left_out.push_back({images[i], reason});
      continue;
    }
    survey.images.push_back(images[i]);
    survey.doubts.push_back(doubtOf(look, typical));
  }
  return survey;
}

double edgeWidth(const cv::Mat& image, const Target& target, const ViewDetections& view) {
  const detect::GrayImage gray = detect::toGray(image);
  if (gray.fine.empty()) return std::nan("");
  const std::vector<Eigen::Vector3d> board = targetPoints(target);
  std::vector<std::optional<Eigen::Vector2d>> at(board.size());
  for (std::size_t i = 0; i < view.points.size(); ++i) {
    for (std::size_t id = 0; id < board.size(); ++id) {
      if ((board[id] - view.points[i]).norm() < 0.01 * target.square_m) at[id] = view.pixels[i];
    }
  }
  // By direction on the board: what moved while it was exposed is sharp along its way.
  std::array<std::vector<double>, 2> widths;
  for (const auto& [a, b] : edgesOf(target)) {
    const auto& pa = at[static_cast<std::size_t>(a)];
    const auto& pb = at[static_cast<std::size_t>(b)];
    if (!pa || !pb) continue;
    const bool across = b - a == 1;
    std::optional<double> width;
    if (target.type == TargetType::kCircles) {
      // From the middle of a dot half way to the next.
      width = widthAlong(gray.fine, *pa, 0.5 * (*pa + *pb));
    } else {
      const Eigen::Vector2d middle = 0.5 * (*pa + *pb);
      Eigen::Vector2d way((*pb - *pa).y(), -(*pb - *pa).x());
      const double share =
          target.type == TargetType::kAprilGrid ? std::min(0.12, 0.5 * target.spacing)
          : target.type == TargetType::kCharuco ? 0.45 * (1.0 - target.marker_m / target.square_m)
                                                : 0.3;
      way *= std::max(share, 4.5 / std::max(1.0, way.norm()));
      width = widthAlong(gray.fine, middle - way, middle + way);
    }
    if (width) widths[across ? 0 : 1].push_back(*width);
  }
  double widest = std::nan("");
  for (const auto& direction : widths) {
    if (direction.size() < 4) continue;
    const double median = medianOf(direction);
    if (!(widest >= median)) widest = median;
  }
  return widest;
}

std::vector<LeftOut> leaveOutPoorViews(const Target& target, int threads, Detections& detections) {
  constexpr double kBlurred = 1.8;      // times the typical width of edges
  constexpr double kSharpEnough = 3.2;  // [px]
  constexpr double kSamePx = 0.15;
  const std::size_t count = detections.views.size();
  std::vector<double> widths(count, std::nan(""));
  std::vector<std::exception_ptr> errors(count);
  parallelFor(0, count, threads, [&](std::size_t i) {
    try {
      const cv::Mat image = readImage(detections.views[i].name, ImageColor::kGray);
      widths[i] = edgeWidth(image, target, detections.views[i]);
    } catch (...) {
      errors[i] = std::current_exception();
    }
  });
  for (const std::exception_ptr& error : errors) {
    if (error) std::rethrow_exception(error);
  }
  std::vector<double> known;
  for (const double width : widths) {
    if (std::isfinite(width)) known.push_back(width);
  }
  const double typical = medianOf(known);
  std::vector<std::string> reasons(count);
  std::size_t blurred = 0;
  for (std::size_t i = 0; i < count; ++i) {
    if (!(widths[i] > kBlurred * typical) || !(widths[i] > kSharpEnough)) continue;
    reasons[i] = "is blurred: edges are " + formatFixed(widths[i], 1) + " px wide, " +
                 formatFixed(typical, 1) + " px is typical";
    ++blurred;
  }
  // Where many are, blur is how these pictures are.
  if (3 * blurred > count) reasons.assign(count, "");
  for (std::size_t i = 0; i < count; ++i) {
    const ViewDetections& view = detections.views[i];
    for (std::size_t k = 0; k < i && reasons[i].empty(); ++k) {
      const ViewDetections& other = detections.views[k];
      if (!reasons[k].empty() || view.points != other.points || view.pixels.empty()) continue;
      double squares = 0.0;
      for (std::size_t c = 0; c < view.pixels.size(); ++c) {
        squares += (view.pixels[c] - other.pixels[c]).squaredNorm();
      }
      if (std::sqrt(squares / static_cast<double>(view.pixels.size())) >= kSamePx) continue;
      const bool first_stays = !isOlder(view.name, other.name);
      reasons[first_stays ? i : k] =
          "shows the board just where " + (first_stays ? other.name : view.name) + " does";
    }
  }
  std::vector<LeftOut> left_out;
  std::vector<ViewDetections> kept;
  for (std::size_t i = 0; i < count; ++i) {
    if (reasons[i].empty()) {
      kept.push_back(std::move(detections.views[i]));
    } else {
      left_out.push_back({detections.views[i].name, reasons[i]});
    }
  }
  detections.views = std::move(kept);
  return left_out;
}

}  // namespace omnister
