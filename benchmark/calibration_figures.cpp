// SPDX-License-Identifier: Apache-2.0
// What lenses and calibrations are held to, measured: each figure beside its limit. `./run bench
// calibration` runs it.
#include <CLI/CLI.hpp>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <functional>
#include <nlohmann/json.hpp>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgcodecs.hpp>
#include <set>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "measure.h"
#include "omnister/calibration/calibrate.h"
#include "omnister/calibration/detector.h"
#include "omnister/calibration/target_free.h"
#include "omnister/calibration/uncertainty.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/common/text.h"
#include "unit/calibration/rendered_scans.h"
#include "unit/calibration/stage_scene.h"
#include "unit/calibration/synthetic_boards.h"
#include "unit/lens/published_lenses.h"
#include "unit/stereo/real_data.h"

namespace omnister::bench {
namespace {

namespace fs = std::filesystem;
using test::dataFolder;
using test::kDegree;
using test::wideLens;
using test::wideScene;

/// Rows of the table, printed as they come.
class Figures {
 public:
  void add(const std::string& name, double value, double limit, const std::string& unit,
           const std::string& note = "") {
    row(name, value, limit, unit, value <= limit, "<= " + formatNumber(limit), note);
  }
  void addBetween(const std::string& name, double value, double low, double high,
                  const std::string& unit) {
    row(name, value, high, unit, value >= low && value <= high,
        formatNumber(low) + " to " + formatNumber(high), "");
  }
  void missing(const std::string& what) {
    std::printf("%-72s not measured: %s\n", what.c_str(), "its data are not there");
    std::fflush(stdout);
  }
  const nlohmann::ordered_json& json() const { return rows_; }
  int short_of() const { return short_of_; }

 private:
  void row(const std::string& name, double value, double limit, const std::string& unit, bool holds,
           const std::string& wanted, const std::string& note) {
    std::printf("%-72s %10.5g %-4s %-14s %s%s%s\n", name.c_str(), value, unit.c_str(),
                wanted.c_str(), holds ? "holds" : "FALLS SHORT", note.empty() ? "" : "  ",
                note.c_str());
    std::fflush(stdout);
    rows_.push_back({{"figure", name},
                     {"value", value},
                     {"limit", limit},
                     {"unit", unit},
                     {"holds", holds},
                     {"note", note}});
    if (!holds) ++short_of_;
  }

  nlohmann::ordered_json rows_ = nlohmann::ordered_json::array();
  int short_of_ = 0;
};

std::string seconds(double value) { return formatFixed(value, 2); }
std::string thousandths(double value) { return formatFixed(value, 3); }

/// The numbers of every <image_N> of OpenCV's recorded corners.
std::vector<std::vector<double>> recordedNumbers(const fs::path& file) {
  const std::string text = readFile(file);
  std::vector<std::vector<double>> images;
  std::size_t at = 0;
  while ((at = text.find("<image_", at)) != std::string::npos) {
    const std::size_t begin = text.find('>', at) + 1;
    const std::size_t end = text.find("</image_", begin);
    std::istringstream words(text.substr(begin, end - begin));
    std::vector<double> numbers;
    for (std::string word; words >> word;) numbers.push_back(std::stod(word));
    images.push_back(std::move(numbers));
    at = end + 1;
  }
  return images;
}

void recorded(Figures& figures) {
  const fs::path folder = dataFolder("opencv_jy_stereo");
  const std::string name = "OpenCV's recorded corners: training RMS, best compact model";
  if (!fs::exists(folder / "left.xml")) return figures.missing(name);
  const auto pixels = recordedNumbers(folder / "left.xml");
  const auto points = recordedNumbers(folder / "object.xml");
  Detections detections;
  detections.image_size = {1280, 800};
  for (std::size_t k = 0; k < pixels.size(); ++k) {
    ViewDetections& view = detections.views.emplace_back();
    view.name = std::to_string(k);
    for (std::size_t i = 0; 2 * i + 1 < pixels[k].size(); ++i) {
      view.pixels.emplace_back(pixels[k][2 * i], pixels[k][2 * i + 1]);
      view.points.emplace_back(points[k][3 * i], points[k][3 * i + 1], points[k][3 * i + 2]);
    }
  }
  double best = HUGE_VAL;
  std::string with;
  for (const char* model : {"conic", "asphere"}) {
    CalibrationOptions options;
    options.model = model;
    for (const CandidateResult& candidate : calibrate(detections, options).candidates) {
      if (candidate.rms_px >= best) continue;
      best = candidate.rms_px;
      with = candidate.structure.model + " r^" +
             std::to_string(2 + 2 * candidate.structure.even_terms) +
             (candidate.structure.affinity ? " + affinity" : "") +
             (candidate.structure.decentring ? " + decentring" : "");
    }
  }
  figures.add(name, best, 0.2638, "px", with + ", " + std::to_string(pixels.size()) + " views");
}

void corners(Figures& figures) {
  struct Set {
    const char* file;
    cv::Size size;
    double limit;
  };
  for (const Set& set : {Set{"opencv_jy_left.csv", {1280, 800}, 0.224},
                         Set{"boofcv_theta.csv", {640, 720}, 0.230}}) {
    const fs::path path = dataFolder("detections") / set.file;
    const std::string name = std::string(set.file) + ": held-out RMS, auto, 5 folds";
    if (!fs::exists(path)) {
      figures.missing(name);
      continue;
    }
    CalibrationOptions options;
    options.folds = 5;
    const CalibrationResult result = calibrate(readDetections(path, set.size), options);
    figures.add(name, *result.holdout_rms_px, set.limit, "px",
                result.file.calibration.notes.at("structure"));
  }
}

void lenses(Figures& figures) {
  const fs::path path = dataFolder("lenses") / "lenses.json";
  if (!fs::exists(path)) return figures.missing("published lenses as surfaces");
  std::vector<double> splines;
  std::vector<double> aspheres;
  for (const auto& entry : nlohmann::json::parse(readFile(path))) {
    const std::string text = test::asFile(entry);
    if (text.empty()) continue;
    const ForeignCamera camera = readForeignCamera(text, entry["name"].get<std::string>());
    const double limit = std::min(95.0 * kDegree, foreignField(camera).one_to_one);
    const auto rms = [&](const char* model, int even_terms) {
      const ForeignFit fit = fitForeignCamera(camera, model, even_terms);
      return test::residual(camera, *fit.fit.lens, limit).rms;
    };
    splines.push_back(rms("spline", 3));
    aspheres.push_back(rms("asphere", 2));
  }
  const std::string count = std::to_string(splines.size()) + " lenses";
  figures.add("published lenses as spline: worst RMS to 95 degrees",
              *std::max_element(splines.begin(), splines.end()), 0.05, "px", count);
  figures.add("  median", medianOf(splines), 0.01, "px");
  figures.add("published lenses as asphere r^6: median RMS", medianOf(aspheres), 0.05, "px");
}

void simulation(Figures& figures, int seeds) {
  const LensPtr truth = wideLens();
  double squares = 0.0;
  double bound = 0.0;
  double worst = 0.0;
  double z_squares = 0.0;
  int z_count = 0;
  int lost = 0;
  for (int seed = 1; seed <= seeds; ++seed) {
    const auto scene = wideScene(static_cast<unsigned>(seed), 0.1);
    const Detections detections = test::simulatedBoards(*truth, scene);
    CalibrationOptions exact;
    exact.structure = structureOf(*truth);
    try {
      const CalibrationResult result = calibrate(detections, {});
      const ProjectionField error =
          projectionDifference(*truth, *result.file.lens, scene.image_size);
      squares += error.rms_px * error.rms_px;
      worst = std::max(worst, error.max_px);
      const CalibrationResult same = calibrate(detections, exact);
      const Eigen::MatrixXd& covariance = *same.file.covariance;
      bound +=
          std::pow(projectionUncertainty(*same.file.lens, covariance, scene.image_size).rms_px, 2);
      const Eigen::VectorXd z = (same.file.lens->parameters() - truth->parameters())
                                    .cwiseQuotient(covariance.diagonal().cwiseSqrt());
      z_squares += z.squaredNorm();
      z_count += static_cast<int>(z.size());
    } catch (const Error& error) {
      std::fprintf(stderr, "seed %d: %s\n", seed, error.what());
      ++lost;
    }
  }
  const int found = std::max(1, seeds - lost);
  const std::string count = std::to_string(seeds) + " seeds";
  figures.add("190 degrees, 20 boards, 0.1 px noise: sets that did not converge", lost, 0, "",
              count);
  figures.add("  RMS over field and seeds", std::sqrt(squares / found), 0.06, "px",
              "least that the corners allow: " + thousandths(std::sqrt(bound / found)));
  figures.add("  largest error anywhere, of all seeds", worst, 0.2, "px");
  figures.addBetween("  covariance: standard deviation of z", std::sqrt(z_squares / z_count), 0.8,
                     1.25, "");
  CalibrationOptions exact;
  exact.structure = structureOf(*truth);
  const auto scene = wideScene(1, 0.0);
  const CalibrationResult clean = calibrate(test::simulatedBoards(*truth, scene), exact);
  figures.add("  without noise",
              projectionDifference(*truth, *clean.file.lens, scene.image_size).max_px, 1e-4, "px");
}

void stage(Figures& figures, int seeds) {
  test::StageScene scene;
  scene.board.cols = 28;
  scene.board.rows = 20;
  scene.board.square = 0.03;
  scene.distance = 0.2;
  double sum = 0.0;
  double squares = 0.0;
  for (int seed = 1; seed <= seeds; ++seed) {
    const double error =
        calibrate(scene.seen(static_cast<unsigned>(seed)), scene.options()).height_px / 300.0 - 1.0;
    sum += error;
    squares += error * error;
  }
  const double mean = sum / seeds;
  figures.add("stage: board at 30 degrees, 5 steps, 0.3 px noise: deviation of R0",
              100.0 * std::sqrt(squares / seeds - mean * mean), 0.02, "%",
              "mean " + formatNumber(std::round(1e6 * mean) * 1e-4) + " %");
}

void scan(Figures& figures) {
  const cv::Size size(1280, 960);
  const test::RenderedScans rendered = test::renderScans(size, 300.0, 9, 3);
  TrackingOptions tracking;
  tracking.features_per_scan = 2000;
  const TargetFreeResult three = calibrateTargetFree(rendered.scans, tracking, {});
  figures.add("no target, rendered room, 3 turned scans of 9 images: angles to 90 degrees",
              test::angleRms(*rendered.lens, *three.file.lens, size, 1.0), 0.05, "deg");
  const TargetFreeResult one = calibrateTargetFree({rendered.scans[0]}, tracking, {});
  figures.add("  one scan, its free scale fitted",
              one.scale == SurfaceScale::kFree
                  ? test::bestAngleRms(*rendered.lens, *one.file.lens, size)
                  : HUGE_VAL,
              0.05, "deg");
}

void detection(Figures& figures) {
  struct Set {
    fs::path folder;
    Target target;
  };
  const Target board{TargetType::kCheckerboard, 8, 6, 0.0244};
  const std::vector<Set> sets = {
      {dataFolder("opencv_jy_stereo") / "left", board},
      {dataFolder("opencv_jy_stereo") / "right", board},
      {dataFolder("boofcv_theta") / "chessboard", Target{TargetType::kCheckerboard, 6, 4, 1.0}}};
  int images = 0;
  int ours = 0;
  int theirs = 0;
  int only_theirs = 0;
  double cpu = 0.0;
  for (const Set& set : sets) {
    if (!fs::is_directory(set.folder)) {
      figures.missing("boards in " + set.folder.filename().string());
      continue;
    }
    std::vector<std::string> files;
    for (const auto& entry : fs::directory_iterator(set.folder)) {
      if (entry.path().extension() == ".jpg") files.push_back(entry.path().string());
    }
    std::sort(files.begin(), files.end());
    DetectorOptions options;
    options.threads = 1;
    std::vector<std::string> missed;
    const Instant begin = Instant::now();
    detectInFiles(files, set.target, options, &missed);
    cpu += Instant::now().cpu - begin.cpu;
    images += static_cast<int>(files.size());
    ours += static_cast<int>(files.size() - missed.size());
    const std::set<std::string> without(missed.begin(), missed.end());
    const cv::Size grid(set.target.cols, set.target.rows);
    for (const std::string& file : files) {
      const cv::Mat image = cv::imread(file, cv::IMREAD_GRAYSCALE);
      std::vector<cv::Point2f> found;
      const bool seen =
          cv::findChessboardCornersSB(image, grid, found,
                                      cv::CALIB_CB_NORMALIZE_IMAGE | cv::CALIB_CB_EXHAUSTIVE) ||
          cv::findChessboardCorners(image, grid, found,
                                    cv::CALIB_CB_ADAPTIVE_THRESH | cv::CALIB_CB_NORMALIZE_IMAGE);
      theirs += seen;
      only_theirs += seen && without.count(file) > 0;
    }
  }
  if (images == 0) return;
  figures.add("boards in the real images that OpenCV's detectors find and ours does not",
              only_theirs, 0, "",
              std::to_string(ours) + " of " + std::to_string(images) +
                  " found, by OpenCV's union " + std::to_string(theirs));
  figures.add("  processor time an image, average", cpu / images, 1.0, "s");
}

void timeCalibration(Figures& figures, const std::string& what, const Detections& detections,
                     int folds, double limit) {
  CalibrationOptions options;
  options.folds = folds;
  const Instant begin = Instant::now();
  const CalibrationResult result = calibrate(detections, options);
  const Instant end = Instant::now();
  figures.add(what + ": processor time", end.cpu - begin.cpu, limit, "s",
              "wall " + seconds(end.wall - begin.wall) + " s, " +
                  result.file.calibration.notes.at("structure"));
}

void speed(Figures& figures) {
  auto scene = wideScene(1, 0.1);
  scene.views = 30;
  scene.cols = 10;
  scene.rows = 5;
  timeCalibration(figures, "30 boards of 50 corners, auto, 5 folds",
                  test::simulatedBoards(*wideLens(), scene), 5, 1.0);
  const fs::path path = dataFolder("detections") / "opencv_jy_left.csv";
  if (fs::exists(path)) {
    timeCalibration(figures, "34 real boards of 48 corners, auto, 5 folds",
                    readDetections(path, {1280, 800}), 5, 1.0);
  }
  timeCalibration(figures, "186 boards of 100 corners, auto, lens with a 2-D spline",
                  test::simulatedBoards(*test::bentLens(), test::bentScene(186)),
                  CalibrationOptions().folds, 10.0);
}

int run(int argc, char** argv) {
  CLI::App app("Figures of lenses and calibration beside their limits");
  std::vector<std::string> wanted;
  int seeds = 20;
  std::string out;
  const std::vector<std::string> names = {"recorded", "corners", "lenses",    "simulation",
                                          "stage",    "scan",    "detection", "time"};
  app.add_option("figures", wanted, "Which; all without a name")->check(CLI::IsMember(names));
  app.add_option("--seeds", seeds, "Sets of the simulations")->check(CLI::Range(2, 1000));
  app.add_option("--out", out, "Folder for calibration.json too");
  CLI11_PARSE(app, argc, argv);
  const auto asked = [&](const char* name) {
    return wanted.empty() || std::find(wanted.begin(), wanted.end(), name) != wanted.end();
  };
  Figures figures;
  if (asked("recorded")) recorded(figures);
  if (asked("corners")) corners(figures);
  if (asked("lenses")) lenses(figures);
  if (asked("simulation")) simulation(figures, seeds);
  if (asked("stage")) stage(figures, seeds);
  if (asked("time")) speed(figures);
  if (asked("detection")) detection(figures);
  if (asked("scan")) scan(figures);
  if (!out.empty()) {
    writeFileAtomically(fs::path(out) / "calibration.json", figures.json().dump(1) + "\n");
  }
  return figures.short_of() == 0 ? 0 : 1;
}

}  // namespace
}  // namespace omnister::bench

int main(int argc, char** argv) {
  return omnister::bench::report("omnister_bench_calibration",
                                 [&] { return omnister::bench::run(argc, argv); });
}
