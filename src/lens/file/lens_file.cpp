// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_file.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "lens/file/equidistant.h"
#include "lens/file/yaml_view.h"
#include "lens/file/yaml_write.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_models.h"

namespace omnister {
namespace {

using namespace detail;

constexpr int kVersion = 1;
constexpr std::size_t kMaxBytes = 4u << 20;
constexpr double kStandardBound = 1.0;        // [px]
constexpr Eigen::Index kMostCovariance = 64;  // parameters

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
  std::string out =
      cameraInfoText(file.image_size, file.camera_name, standard ? *fit : StandardCameraInfo());
  out += "lens_surface:\n";
  out += "  version: " + std::to_string(kVersion) + "\n";
  out += "  model: " + std::string(lens.model()) + "\n";
  const Eigen::Vector2d center = lens.center();
  out += "  center: " + yamlFlow(std::vector<double>{center.x(), center.y()}) + "\n";
  out += "  max_theta: " + yamlNumber(lens.maxTheta()) + "\n";
  out += "  parameters:\n";
  for (const auto& [name, values] : namedParameters(lens)) {
    const bool list = name == "radii" || name == "bend";
    out += "    " + name + ": " + (list ? yamlFlow(values) : yamlNumber(values.at(0))) + "\n";
  }
  if (file.covariance) {
    const auto size = lens.parameters().size();
    if (file.covariance->rows() != size || file.covariance->cols() != size ||
        !file.covariance->allFinite()) {
      throw Error("the covariance of a " + std::string(lens.model()) + " lens needs " +
                  std::to_string(size) + " rows and columns of finite numbers");
    }
    // The square of a grid's size would dwarf all else; what it says in sum stands in the notes.
    if (size <= kMostCovariance) {
      out += "  covariance: " + yamlRowMajor(*file.covariance) + "\n";
    }
  }
  if (file.stage_axis) {
    out += "  stage_axis: " +
           yamlFlow(std::vector<double>(file.stage_axis->data(), file.stage_axis->data() + 3)) +
           "\n";
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
