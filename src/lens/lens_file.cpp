// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_file.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "equidistant.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_models.h"
#include "yaml_view.h"

namespace omnister {
namespace {

using detail::YamlView;

constexpr int kVersion = 1;
constexpr std::size_t kMaxBytes = 4u << 20;
constexpr double kStandardBound = 1.0;  // [px]

// ---------------------------------------------------------------- reading

// A camera_info matrix {rows, cols, data}. Checked here since ROS' own parser trusts it.
void checkMatrix(const YamlView& root, const std::string& key, int rows, std::optional<int> cols) {
  const auto matrix = root.find(key);
  if (!matrix) return;
  matrix->at("rows").whole(rows, rows);
  const int width =
      cols ? matrix->at("cols").whole(*cols, *cols) : matrix->at("cols").whole(0, 100);
  matrix->at("data").numbers(static_cast<std::size_t>(rows) * width);
}

CalibrationRecord readRecord(const YamlView& block) {
  CalibrationRecord out;
  const auto figure = [&](const char* key, std::optional<double>& value) {
    if (const auto entry = block.find(key)) {
      value = entry->number();
      if (*value < 0.0) entry->refuse("is negative, expected pixels");
    }
  };
  figure("rms_px", out.rms_px);
  figure("holdout_rms_px", out.holdout_rms_px);
  figure("equidistant_residual_px", out.equidistant_residual_px);
  constexpr int kMany = 1000000000;
  if (const auto views = block.find("views")) out.views = views->whole(0, kMany);
  if (const auto points = block.find("points")) out.points = points->whole(0, kMany);
  if (const auto date = block.find("date")) out.date = date->text();
  if (const auto notes = block.find("notes")) {
    for (const std::string& key : notes->keys()) {
      if (const auto note = notes->find(key)) out.notes[key] = note->text();
    }
  }
  return out;
}

Eigen::MatrixXd readCovariance(const YamlView& entry, int size) {
  const std::vector<double> data = entry.numbers(static_cast<std::size_t>(size) * size);
  const Eigen::MatrixXd out =
      Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>(
          data.data(), size, size);
  for (int i = 0; i < size; ++i) {
    if (out(i, i) < 0.0) entry.refuse("has a negative variance in row " + std::to_string(i + 1));
    for (int j = 0; j < i; ++j) {
      const double bound = std::sqrt(out(i, i) * out(j, j));
      if (std::abs(out(i, j) - out(j, i)) > 1e-6 * bound) {
        entry.refuse("is not symmetric in row " + std::to_string(i + 1) + ", column " +
                     std::to_string(j + 1));
      }
    }
  }
  return out;
}

// ---------------------------------------------------------------- writing

// YAML 1.1 readers take 1e-05 for text: they want a point in it.
std::string yamlNumber(double value) {
  std::string out = formatNumber(value);
  const std::size_t exponent = out.find('e');
  if (exponent != std::string::npos && out.find('.') == std::string::npos) {
    out.insert(exponent, ".0");
  }
  return out;
}

template <typename Numbers>
std::string flow(const Numbers& numbers) {
  std::string out = "[";
  for (const double value : numbers) {
    if (out.size() > 1) out += ", ";
    out += yamlNumber(value);
  }
  return out + "]";
}

template <typename Derived>
std::string rowMajor(const Eigen::MatrixBase<Derived>& matrix) {
  std::vector<double> out;
  for (int i = 0; i < matrix.rows(); ++i) {
    for (int j = 0; j < matrix.cols(); ++j) out.push_back(matrix(i, j));
  }
  return flow(out);
}

// Plain when no YAML reader could take it for anything but a word.
std::string yamlText(const std::string& text) {
  const auto letter = [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_';
  };
  static const std::vector<std::string> kReserved{"null", "true", "false", "yes", "no", "on",
                                                  "off",  "y",    "n",     "nan", "inf"};
  std::string lower;
  bool plain = !text.empty() && letter(text[0]);
  for (const char c : text) {
    plain = plain && (letter(c) || (c >= '0' && c <= '9') || c == '-' || c == '.' || c == '/');
    lower += static_cast<char>(c >= 'A' && c <= 'Z' ? c - 'A' + 'a' : c);
  }
  if (plain && std::find(kReserved.begin(), kReserved.end(), lower) == kReserved.end()) return text;
  std::string out = "\"";
  static constexpr char kHex[] = "0123456789ABCDEF";
  for (const char c : text) {
    const auto byte = static_cast<unsigned char>(c);
    if (c == '"' || c == '\\') {
      out += '\\';
      out += c;
    } else if (byte < 0x20 || byte == 0x7F) {
      out += "\\x";
      out += kHex[byte >> 4];
      out += kHex[byte & 15];
    } else {
      out += c;
    }
  }
  return out + "\"";
}

std::string matrixBlock(const std::string& key, int rows, int cols, const std::string& data) {
  return key + ":\n  rows: " + std::to_string(rows) + "\n  cols: " + std::to_string(cols) +
         "\n  data: " + data + "\n";
}

}  // namespace

std::optional<StandardCameraInfo> nearestStandardModel(const LensModel& lens, cv::Size image_size) {
  auto fit = detail::fitEquidistant(lens, image_size);
  if (!fit || !(fit->worst_residual_px < kStandardBound)) return std::nullopt;
  return fit;
}

LensFile parseLensFile(std::string_view text, std::string_view source) {
  const YamlView root = YamlView::load(text, source);
  const auto surface = root.find("lens_surface");
  if (!surface) {
    throw InputError(source, "lens_surface",
                     "is missing, so this is no lens file; `omnister import` makes one from a "
                     "camera_info, Kalibr, OCamCalib or mrcal calibration");
  }
  LensFile out;
  out.image_size.width = root.at("image_width").whole(1, 65535);
  out.image_size.height = root.at("image_height").whole(1, 65535);
  if (const auto name = root.find("camera_name")) out.camera_name = name->text();
  if (const auto model = root.find("distortion_model")) model->text();
  checkMatrix(root, "camera_matrix", 3, 3);
  checkMatrix(root, "distortion_coefficients", 1, std::nullopt);
  checkMatrix(root, "rectification_matrix", 3, 3);
  checkMatrix(root, "projection_matrix", 3, 4);

  const YamlView version = surface->at("version");
  if (version.number() != kVersion) {
    version.refuse("is " + printable(version.text()) + ", expected " + std::to_string(kVersion));
  }
  const std::string model = surface->at("model").text();
  const std::vector<double> center = surface->at("center").numbers(2);
  const double max_theta = surface->at("max_theta").number();
  std::map<std::string, std::vector<double>> parameters;
  const YamlView block = surface->at("parameters");
  for (const std::string& key : block.keys()) {
    const YamlView entry = block.at(key);
    parameters[key] = entry.isSequence() ? entry.numbers() : std::vector<double>{entry.number()};
  }
  out.lens = makeLens(model, {center[0], center[1]}, parameters, max_theta, source);
  if (const auto covariance = surface->find("covariance")) {
    out.covariance = readCovariance(*covariance, static_cast<int>(out.lens->parameters().size()));
  }
  if (const auto axis = surface->find("stage_axis")) {
    const std::vector<double> a = axis->numbers(3);
    const Eigen::Vector3d direction(a[0], a[1], a[2]);
    if (!(std::abs(direction.norm() - 1.0) < 1e-6)) axis->refuse("is no unit vector");
    out.stage_axis = direction;
  }
  if (const auto record = surface->find("calibration")) out.calibration = readRecord(*record);
  return out;
}

LensFile readLensFile(const std::filesystem::path& path) {
  return parseLensFile(readFile(path, kMaxBytes), path.string());
}

std::string formatLensFile(const LensFile& file) {
  if (file.lens == nullptr || file.image_size.width < 1 || file.image_size.height < 1 ||
      file.image_size.width > 65535 || file.image_size.height > 65535) {
    throw Error("a lens file needs a lens and an image size of 1 to 65535 pixels");
  }
  const LensModel& lens = *file.lens;
  const auto fit = detail::fitEquidistant(lens, file.image_size);
  const bool standard = fit && fit->worst_residual_px < kStandardBound;
  Eigen::Matrix<double, 3, 4> P = Eigen::Matrix<double, 3, 4>::Zero();
  if (standard) P.leftCols<3>() = fit->K;

  std::string out;
  out += "image_width: " + std::to_string(file.image_size.width) + "\n";
  out += "image_height: " + std::to_string(file.image_size.height) + "\n";
  out += "camera_name: " + yamlText(file.camera_name) + "\n";
  out += matrixBlock("camera_matrix", 3, 3,
                     rowMajor(standard ? fit->K : Eigen::Matrix3d(Eigen::Matrix3d::Zero())));
  out += "distortion_model: " + yamlText(standard ? fit->distortion_model : "") + "\n";
  const std::vector<double> D = standard ? fit->D : std::vector<double>{};
  out += matrixBlock("distortion_coefficients", 1, static_cast<int>(D.size()), flow(D));
  out += matrixBlock("rectification_matrix", 3, 3, rowMajor(Eigen::Matrix3d::Identity()));
  out += matrixBlock("projection_matrix", 3, 4, rowMajor(P));

  out += "lens_surface:\n";
  out += "  version: " + std::to_string(kVersion) + "\n";
  out += "  model: " + std::string(lens.model()) + "\n";
  const Eigen::Vector2d center = lens.center();
  out += "  center: " + flow(std::vector<double>{center.x(), center.y()}) + "\n";
  out += "  max_theta: " + yamlNumber(lens.maxTheta()) + "\n";
  out += "  parameters:\n";
  for (const auto& [name, values] : namedParameters(lens)) {
    const bool list = name == "radii";
    out += "    " + name + ": " + (list ? flow(values) : yamlNumber(values.at(0))) + "\n";
  }
  if (file.covariance) {
    const auto size = lens.parameters().size();
    if (file.covariance->rows() != size || file.covariance->cols() != size ||
        !file.covariance->allFinite()) {
      throw Error("the covariance of a " + std::string(lens.model()) + " lens needs " +
                  std::to_string(size) + " rows and columns of finite numbers");
    }
    out += "  covariance: " + rowMajor(*file.covariance) + "\n";
  }
  if (file.stage_axis) {
    out += "  stage_axis: " +
           flow(std::vector<double>(file.stage_axis->data(), file.stage_axis->data() + 3)) + "\n";
  }
  const CalibrationRecord& record = file.calibration;
  std::string block;
  const auto figure = [&](const char* key, const std::optional<double>& value) {
    if (value && std::isfinite(*value)) {
      block += std::string("    ") + key + ": " + yamlNumber(*value) + "\n";
    }
  };
  figure("rms_px", record.rms_px);
  figure("holdout_rms_px", record.holdout_rms_px);
  if (record.views) block += "    views: " + std::to_string(*record.views) + "\n";
  if (record.points) block += "    points: " + std::to_string(*record.points) + "\n";
  if (!record.date.empty()) block += "    date: \"" + printable(record.date) + "\"\n";
  figure("equidistant_residual_px",
         fit ? std::optional<double>(fit->worst_residual_px) : std::nullopt);
  if (!record.notes.empty()) {
    block += "    notes:\n";
    for (const auto& [key, note] : record.notes) {
      block += "      " + yamlText(key) + ": " + yamlText(note) + "\n";
    }
  }
  if (!block.empty()) out += "  calibration:\n" + block;
  return out;
}

void writeLensFile(const std::filesystem::path& path, const LensFile& file) {
  writeFileAtomically(path, formatLensFile(file), Previous::kKeep);
}

}  // namespace omnister
