// SPDX-License-Identifier: Apache-2.0
/// @file Our matchers beside OpenCV's on one rendered pair in one process: times, memory and
/// errors. `omnister_bench_stereo --help` lists the suites. OMNISTER_SIMD=avx2 or scalar holds the
/// sweep's dispatch.
#include <CLI/CLI.hpp>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <functional>
#include <memory>
#include <nlohmann/json.hpp>
#include <opencv2/core.hpp>
#include <opencv2/core/utils/logger.hpp>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "measure.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"
#include "omnister/common/parallel.h"
#include "omnister/lens/lens_file.h"
#include "omnister/sim/scene.h"
#include "plot.h"
#include "rectified_stereo.h"
#include "requirements.h"
#include "stereo_pair.h"

namespace omnister::bench {
namespace {

using Json = nlohmann::ordered_json;

struct Settings {
  std::string suite = "compare";
  std::string scenes = OMNISTER_SCENES;
  std::string scene = "room";
  std::string lens;
  std::vector<std::string> sizes{"1280x960"};
  std::vector<int> threads;
  std::vector<std::string> methods{"sweep", "bm", "3way", "sgbm"};
  int runs = 5;
  int thesis_row = 0;
  double noise = 0.0;
  std::string out;
};

/// One method at one size and number of threads.
struct Row {
  std::string scene, size, method;
  int threads = 1;
  double wall_ms = 0.0, cpu_ms = 0.0;
  double match_ms = 0.0;    ///< without rectification and transfer; the sweep has neither
  double setup_ms = 0.0;    ///< for a new lens or pose
  double memory_mib = 0.0;  ///< peak of set-up and one frame, above images and process
  double output_mib = 0.0;  ///< of which is the result itself
  std::string remark;
  Score score;
  std::map<std::string, double> stages_ms;
};

cv::Size parseSize(const std::string& text) {
  const auto cross = text.find('x');
  const auto w = cross == std::string::npos ? std::nullopt : parseNumber(text.substr(0, cross));
  const auto h = cross == std::string::npos ? std::nullopt : parseNumber(text.substr(cross + 1));
  if (!w || !h || *w < 16 || *h < 16 || *w > 16384 || *h > 16384) {
    throw Error("size is '" + printable(text) + "', expected WxH such as 1280x960");
  }
  return {static_cast<int>(*w), static_cast<int>(*h)};
}

std::string sizeText(cv::Size size) {
  return std::to_string(size.width) + "x" + std::to_string(size.height);
}

sim::ScenePtr loadScene(const Settings& settings, const std::string& name) {
  const std::filesystem::path given(name);
  return sim::readScene(
      given.has_extension() ? given : std::filesystem::path(settings.scenes) / (name + ".yaml"));
}

/// The lens for an image size: a file's own, or the equidistant one.
LensPtr lensFor(const Settings& settings, cv::Size& size) {
  if (settings.lens.empty()) return equidistant180(size);
  const LensFile file = readLensFile(settings.lens);
  size = file.image_size;
  return file.lens;
}

/// Something that takes one pair and gives range, timed from outside.
struct Contestant {
  std::string method;
  std::function<cv::Mat(RectifiedStereo::Times*, std::map<std::string, double>*)> frame;
  std::vector<double> wall, cpu, match;
  std::vector<std::map<std::string, double>> stages;
  Row row;
};

Json toJson(const Row& row) {
  Json json{{"scene", row.scene},
            {"size", row.size},
            {"threads", row.threads},
            {"method", row.method},
            {"wall_ms", row.wall_ms},
            {"cpu_ms", row.cpu_ms},
            {"match_ms", row.match_ms},
            {"setup_ms", row.setup_ms},
            {"memory_mib", row.memory_mib},
            {"output_mib", row.output_mib},
            {"density", row.score.density},
            {"median_percent", row.score.median_percent},
            {"over_1px", row.score.over_1px},
            {"over_2percent", row.score.over_2percent},
            {"occluded_filled", row.score.occluded_filled},
            {"truth_pixels", row.score.truth}};
  if (!row.remark.empty()) json["remark"] = row.remark;
  for (const auto& band : row.score.bands) {
    json["bands"].push_back({{"from_deg", band.from_deg},
                             {"to_deg", band.to_deg},
                             {"truth_pixels", band.truth},
                             {"density", band.density},
                             {"median_percent", band.median_percent},
                             {"over_1px", band.over_1px}});
  }
  if (!row.stages_ms.empty()) json["stages_ms"] = row.stages_ms;
  return json;
}

void printHead() {
  std::printf("%-9s %3s %-8s %9s %9s %9s %8s %8s %7s %8s %7s %7s %8s %8s %8s  %s\n", "size", "thr",
              "method", "wall ms", "cpu ms", "match ms", "x sweep", "setup ms", "MiB", "density",
              "med %", ">1px %", ">2% %", "occl.", "rim den", "rim med %");
}

void printRow(const Row& row, double reference_ms) {
  double rim_density = std::nan("");
  double rim_median = std::nan("");
  for (const auto& band : row.score.bands) {
    if (band.from_deg == 80.0) {
      rim_density = band.density;
      rim_median = band.median_percent;
    }
  }
  const double own = row.threads == 1 ? row.cpu_ms : row.wall_ms;
  std::printf(
      "%-9s %3d %-8s %9.1f %9.1f %9.1f %8.2f %8.0f %7.0f %8.4f %7.3f %7.3f %8.3f %8.3f %8.3f  "
      "%.3f%s\n",
      row.size.c_str(), row.threads, row.method.c_str(), row.wall_ms, row.cpu_ms, row.match_ms,
      own / reference_ms, row.setup_ms, row.memory_mib, row.score.density, row.score.median_percent,
      100 * row.score.over_1px, 100 * row.score.over_2percent, row.score.occluded_filled,
      rim_density, rim_median, row.remark.empty() ? "" : ("  (" + row.remark + ")").c_str());
  std::fflush(stdout);
}

/// Work that shares nothing: how well this machine can scale just now.
double probeSeconds(int threads) {
  const Instant start = Instant::now();
  std::vector<double> sums(256);
  parallelFor(0, sums.size(), threads, [&](std::size_t i) {
    double x = 1.0 + static_cast<double>(i);
    for (int k = 0; k < 40000; ++k) x = std::sqrt(x + 1.0);
    sums[i] = x;
  });
  volatile double keep = sums[17];
  (void)keep;
  return Instant::now().wall - start.wall;
}

Contestant makeContestant(const std::string& method, const StereoCase& pair, int threads) {
  Contestant contestant;
  contestant.method = method;
  const PeakMemory memory;
  const Instant start = Instant::now();
  const bool cost = method == "zncc" || method == "eq3.1";
  const bool window = method == "ray" || method == "fronto" || method == "best";
  if (method == "sweep" || method == "thesis" || cost || window) {
    MatcherOptions options;
    options.threads = threads;
    if (cost) options.cost = parseMatchCost(method);
    if (window) options.window = parseMatchWindow(method);
    std::shared_ptr<Matcher> matcher =
        makeMatcher(method == "thesis" ? method : "sweep", pair.geometry, options);
    contestant.frame = [matcher, &pair](RectifiedStereo::Times*,
                                        std::map<std::string, double>* stages) {
      MatchResult result = matcher->match(pair.reference, pair.displaced);
      if (stages != nullptr) *stages = result.statistics.seconds;
      return result.range;
    };
    contestant.row.output_mib = 3.0 * 4.0 * pair.reference.total() / 1048576.0;
  } else {
    auto stereo = std::make_shared<RectifiedStereo>(method, pair.geometry, pair.focal_px, threads);
    contestant.frame = [stereo, &pair](RectifiedStereo::Times* times,
                                       std::map<std::string, double>*) {
      return stereo->match(pair.reference, pair.displaced[0], times);
    };
    contestant.row.output_mib = 4.0 * pair.reference.total() / 1048576.0;
  }
  contestant.row.setup_ms = 1e3 * (Instant::now().cpu - start.cpu);
  // The first frame is not timed: it also shows the errors and the memory.
  contestant.row.score = score(pair, contestant.frame(nullptr, nullptr));
  contestant.row.memory_mib = memory.mebibytes();
  return contestant;
}

/// All methods by turns, `runs` times.
std::vector<Row> race(const StereoCase& pair, const std::vector<std::string>& methods, int threads,
                      int runs) {
  cv::setNumThreads(threads);
  std::vector<Contestant> contestants;
  for (const std::string& method : methods) {
    contestants.push_back(makeContestant(method, pair, threads));
  }
  for (int run = 0; run < runs; ++run) {
    for (Contestant& contestant : contestants) {
      RectifiedStereo::Times times;
      std::map<std::string, double> stages;
      const Instant start = Instant::now();
      contestant.frame(&times, &stages);
      const Instant end = Instant::now();
      contestant.wall.push_back(1e3 * (end.wall - start.wall));
      contestant.cpu.push_back(1e3 * (end.cpu - start.cpu));
      contestant.match.push_back(times.match > 0.0 ? 1e3 * times.match
                                                   : 1e3 * (end.wall - start.wall));
      contestant.stages.push_back(stages);
    }
  }
  std::vector<Row> rows;
  for (Contestant& contestant : contestants) {
    Row row = contestant.row;
    row.scene = pair.name;
    row.size = sizeText(pair.reference.size());
    row.method = contestant.method;
    row.threads = threads;
    row.wall_ms = medianOf(contestant.wall);
    row.cpu_ms = medianOf(contestant.cpu);
    row.match_ms = medianOf(contestant.match);
    for (const auto& [stage, unused] : contestant.stages.front()) {
      std::vector<double> all;
      for (auto& stages : contestant.stages) all.push_back(1e3 * stages[stage]);
      row.stages_ms[stage] = medianOf(all);
    }
    rows.push_back(row);
  }
  return rows;
}

/// The thesis' own matcher on every n-th row only, its time scaled to the frame.
Row thesisOnRows(const StereoCase& pair, int every, int threads) {
  cv::Mat mask(pair.reference.size(), CV_8UC1, cv::Scalar(0));
  for (int y = every / 2; y < mask.rows; y += every) mask.row(y).setTo(255);
  const cv::Mat judged = mask & (pair.kind != kOutside);
  MatcherOptions options;
  options.threads = threads;
  options.mask = mask;
  const auto matcher = makeMatcher("thesis", pair.geometry, options);
  const Instant start = Instant::now();
  const MatchResult result = matcher->match(pair.reference, pair.displaced);
  const Instant end = Instant::now();
  const double scale = static_cast<double>(cv::countNonZero(pair.kind != kOutside)) /
                       std::max(1, cv::countNonZero(judged));
  Row row;
  row.scene = pair.name;
  row.size = sizeText(pair.reference.size());
  row.method = "thesis";
  row.threads = threads;
  row.wall_ms = row.match_ms = 1e3 * scale * (end.wall - start.wall);
  row.cpu_ms = 1e3 * scale * (end.cpu - start.cpu);
  row.memory_mib = std::nan("");
  row.score = score(pair, result.range, mask);
  row.remark = "every " + std::to_string(every) + "th row, one run; times scaled to the frame";
  return row;
}

void compare(const Settings& settings, Json& json) {
  const sim::ScenePtr scene = loadScene(settings, settings.scene);
  std::printf(
      "\nOurs beside OpenCV's on 178 x 178 degrees of latitude and longitude; scene %s, medians of "
      "%d.\n"
      "x sweep: time over the sweep's (processor time for one thread, else wall clock), outputs\n"
      "included. Errors are over pixels that both cameras see; occl.: hidden pixels filled all "
      "the\n"
      "same; rim: 80 to 90 degrees off the axis.\n\n",
      settings.scene.c_str(), settings.runs);
  printHead();
  for (const std::string& text : settings.sizes) {
    cv::Size size = parseSize(text);
    const LensPtr lens = lensFor(settings, size);
    CaseOptions options;
    options.noise_sigma = settings.noise;
    const StereoCase pair = makeCase(settings.scene, *scene, lens, size, options);
    std::map<int, double> sweep_wall;
    for (const int threads : settings.threads) {
      const std::vector<Row> rows = race(pair, settings.methods, threads, settings.runs);
      double reference = std::nan("");
      for (const Row& row : rows) {
        if (row.method == "sweep") {
          reference = threads == 1 ? row.cpu_ms : row.wall_ms;
          sweep_wall[threads] = row.wall_ms;
        }
      }
      for (const Row& row : rows) {
        printRow(row, reference);
        json["rows"].push_back(toJson(row));
      }
      if (settings.thesis_row > 0 && threads == 1) {
        const Row row = thesisOnRows(pair, settings.thesis_row, threads);
        printRow(row, reference);
        json["rows"].push_back(toJson(row));
      }
    }
    if (sweep_wall.count(1) != 0) {
      for (const auto& [threads, wall] : sweep_wall) {
        if (threads == 1) continue;
        std::vector<double> one, all;
        for (int i = 0; i < 5; ++i) {
          one.push_back(probeSeconds(1));
          all.push_back(probeSeconds(threads));
        }
        const double possible = medianOf(one) / medianOf(all);
        const double reached = sweep_wall[1] / wall;
        std::printf(
            "%s: %d threads make the sweep %.2f times faster, a perfectly parallel probe %.2f "
            "times: %.2f of what can be had\n",
            text.c_str(), threads, reached, possible, reached / possible);
        json["scaling"].push_back({{"size", text},
                                   {"threads", threads},
                                   {"sweep", reached},
                                   {"probe", possible},
                                   {"share", reached / possible}});
      }
    }
  }
}

cv::Mat sweepRange(const StereoCase& pair) {
  return makeMatcher("sweep", pair.geometry, {})->match(pair.reference, pair.displaced).range;
}

void accuracy(const Settings& settings, Json& json) {
  Requirements required;
  const auto report = [&](const std::string& what, const StereoCase& pair, const cv::Mat& range) {
    const Score s = score(pair, range);
    std::printf("%-34s density %.4f  median %.3f %%  >1px %.3f %%  >2%% %.3f %%  occluded %.3f\n",
                what.c_str(), s.density, s.median_percent, 100 * s.over_1px, 100 * s.over_2percent,
                s.occluded_filled);
    for (const auto& band : s.bands) {
      std::printf(
          "    %3.0f to %3.0f degrees  %8zu px  density %.4f  median %.3f %%  >1px %.3f %%\n",
          band.from_deg, band.to_deg, band.truth, band.density, band.median_percent,
          100 * band.over_1px);
    }
    Row row;
    row.scene = pair.name;
    row.size = sizeText(pair.reference.size());
    row.method = what;
    row.score = s;
    json["rows"].push_back(toJson(row));
    std::fflush(stdout);
    return s;
  };
  // Of the bands of off-axis angle between two limits [degrees] the worst.
  const auto worstMedian = [](const Score& s, double from, double to) {
    double worst = 0.0;
    for (const auto& band : s.bands)
      if (band.from_deg >= from && band.to_deg <= to) worst = std::max(worst, band.median_percent);
    return worst;
  };
  cv::Size size = parseSize(settings.sizes.front());
  const LensPtr lens = lensFor(settings, size);
  CaseOptions options;
  options.noise_sigma = settings.noise;
  std::printf("\nErrors of the sweep, %s\n", sizeText(size).c_str());
  for (const char* name : {"room", "corridor", "weak_texture"}) {
    const StereoCase pair = makeCase(name, *loadScene(settings, name), lens, size, options);
    const Score s = report(name, pair, sweepRange(pair));
    const std::string which = name;
    if (which == "weak_texture") required.check("weak texture: median [%]", s.median_percent, 0.42);
    if (which != "room") continue;
    required.check("room: density", s.density, 0.98, true);
    required.check("room: median [%]", s.median_percent, 0.20);
    required.check("room: more than 1 px [%]", 100 * s.over_1px, 0.45);
    required.check("room: more than 2 % [%]", 100 * s.over_2percent, 1.5);
    required.check("room: occluded pixels that get a depth", s.occluded_filled, 0.15);
    required.check("room, 80 to 90 degrees: median [%]", worstMedian(s, 80, 90), 0.30);
    for (const auto& band : s.bands)
      if (band.from_deg == 80)
        required.check("room, 80 to 90 degrees: density", band.density, 0.98, true);
  }
  for (const char* name : {"room", "weak_texture"}) {
    CaseOptions noisy = options;
    noisy.noise_sigma = 2.0;
    const StereoCase pair = makeCase(name, *loadScene(settings, name), lens, size, noisy);
    report(std::string(name) + ", noise of 2 levels", pair, sweepRange(pair));
  }
  {
    const sim::ScenePtr plane = loadScene(settings, "plane");
    CaseOptions wall = options;
    wall.baseline = 0.25;  // the wall stands at 2 m
    const StereoCase pair = makeCase("plane at 8 baselines", *plane, lens, size, wall);
    const cv::Mat range = sweepRange(pair);
    const Score s = report("plane at 8 baselines", pair, range);
    required.check("plane at 8 baselines, within 40 degrees: worst median [%]",
                   worstMedian(s, 0, 40), 0.12);
    required.check("plane at 8 baselines, 60 to 70 degrees: median [%]", worstMedian(s, 60, 70),
                   0.40);
    constexpr int kBins = 10;
    const std::vector<double> bias = biasByPhase(pair, range, kBins);
    double worst = 0.0;
    std::printf("    bias by phase of the true parallax [px]:");
    for (const double b : bias) {
      std::printf(" %+.4f", b);
      worst = std::max(worst, std::abs(b));
    }
    std::printf("   worst %.4f\n", worst);
    required.check("plane at 8 baselines: worst bias by phase [px]", worst, 0.03);
    json["bias_by_phase_px"] = bias;
  }
  // More positions: the same step (so more travel), and the same travel.
  const sim::ScenePtr room = loadScene(settings, "room");
  const StereoCase two = makeCase("room", *room, lens, size, options);
  const double baseline = two.geometry.displaced[0].T_ref_disp.translation().norm();
  {
    CaseOptions many = options;
    many.baseline = baseline / 4.0;
    const StereoCase step = makeCase("room, one quarter step", *room, lens, size, many);
    const Score of_step = report("2 positions, a quarter step", step, sweepRange(step));
    many.positions = 4;
    const StereoCase five = makeCase("room, four quarter steps", *room, lens, size, many);
    const cv::Mat of_five = sweepRange(five);
    const Score steps = report("5 positions, the same step", five, of_five);
    required.check("five positions over two of the same step: median",
                   steps.median_percent / of_step.median_percent, 0.35);
    // The pair of the whole travel, judged where it cannot see.
    const cv::Mat of_two = sweepRange(two);
    required.check("five positions over two of the same travel: median",
                   score(two, of_five).median_percent / score(two, of_two).median_percent, 1.0);
    std::size_t hidden = 0, two_right = 0, five_right = 0;
    for (int y = 0; y < size.height; ++y) {
      for (int x = 0; x < size.width; ++x) {
        if (two.kind.at<uchar>(y, x) != kOccluded || five.kind.at<uchar>(y, x) != kTruth) continue;
        ++hidden;
        const float truth = two.range.at<float>(y, x);
        const auto right = [&](const cv::Mat& range) {
          return std::abs(range.at<float>(y, x) / truth - 1.0f) < 0.02f;
        };
        two_right += right(of_two) ? 1 : 0;
        five_right += right(of_five) ? 1 : 0;
      }
    }
    std::printf(
        "where only the nearer positions see (%zu px): right to 2 %%: two positions %.3f, five "
        "%.3f\n",
        hidden, static_cast<double>(two_right) / hidden, static_cast<double>(five_right) / hidden);
    required.check("where two are hidden from each other: right of five over right of two",
                   static_cast<double>(five_right) / std::max<std::size_t>(two_right, 1), 1.0,
                   true);
    json["hidden_from_last"] = {{"pixels", hidden},
                                {"right_of_two", static_cast<double>(two_right) / hidden},
                                {"right_of_five", static_cast<double>(five_right) / hidden}};
  }
  std::printf("%d figure(s) fall short\n", required.fallShort());
  json["required"] = required.json();
}

void scaling(const Settings& settings, Json& json) {
  const sim::ScenePtr scene = loadScene(settings, settings.scene);
  std::printf("\nCost of the sweep, medians of %d\n", settings.runs);
  std::vector<Series> charts;
  const auto timed = [&](const StereoCase& pair, const MatcherOptions& options,
                         bool wall_clock = false) {
    const auto matcher = makeMatcher("sweep", pair.geometry, options);
    matcher->match(pair.reference, pair.displaced);
    std::vector<double> spent;
    for (int run = 0; run < settings.runs; ++run) {
      const Instant start = Instant::now();
      matcher->match(pair.reference, pair.displaced);
      const Instant end = Instant::now();
      spent.push_back(1e3 * (wall_clock ? end.wall - start.wall : end.cpu - start.cpu));
    }
    return medianOf(spent);
  };
  const auto add = [&](Series& series, double x, double ms) {
    series.points.emplace_back(x, ms);
    std::printf("%-28s %10g %10.2f ms\n", series.x_label.c_str(), x, ms);
    std::fflush(stdout);
    json["points"].push_back({{"of", series.x_label}, {"x", x}, {"ms", ms}});
  };
  MatcherOptions one;
  one.threads = 1;
  CaseOptions options;
  options.noise_sigma = settings.noise;
  Series pixels{"pixels [million]", "time of a frame, one thread [ms]", {}};
  for (const cv::Size size : {cv::Size(320, 240), cv::Size(640, 480), cv::Size(960, 720),
                              cv::Size(1280, 960), cv::Size(1920, 1440)}) {
    const StereoCase pair = makeCase("room", *scene, equidistant180(size), size, options);
    add(pixels, 1e-6 * size.area(), timed(pair, one));
  }
  charts.push_back(pixels);
  const cv::Size size(1280, 960);
  const LensPtr lens = equidistant180(size);
  const StereoCase pair = makeCase("room", *scene, lens, size, options);
  Series hypotheses{"most hypotheses", "time of a frame, one thread [ms]", {}};
  for (const int n : {16, 32, 64, 128}) {
    MatcherOptions limited = one;
    limited.hypotheses = n;
    add(hypotheses, n, timed(pair, limited));
  }
  charts.push_back(hypotheses);
  Series positions{"displaced images", "time of a frame, one thread [ms]", {}};
  for (const int n : {1, 2, 3, 4}) {
    CaseOptions many = options;
    many.positions = n;
    many.baseline = pair.geometry.displaced[0].T_ref_disp.translation().norm() / n;
    add(positions, n, timed(makeCase("room", *scene, lens, size, many), one));
  }
  charts.push_back(positions);
  Series threads{"threads", "time of a frame, wall clock [ms]", {}};
  const int most = threadCount(0);
  for (int n = 1; n <= most; n = n < most && 2 * n > most ? most : 2 * n) {
    MatcherOptions some;
    some.threads = n;
    add(threads, n, timed(pair, some, true));
  }
  charts.push_back(threads);
  if (!settings.out.empty()) {
    writeFileAtomically(std::filesystem::path(settings.out) / "sweep_cost.svg", drawCharts(charts));
    std::string csv = "of,x,ms\n";
    for (const Series& series : charts) {
      for (const auto& [x, y] : series.points) {
        csv += series.x_label + "," + formatNumber(x) + "," + formatNumber(y) + "\n";
      }
    }
    writeFileAtomically(std::filesystem::path(settings.out) / "sweep_cost.csv", csv);
  }
}

std::string toCsv(const Json& rows) {
  const char* columns[] = {"scene",      "size",          "threads",         "method",
                           "wall_ms",    "cpu_ms",        "match_ms",        "setup_ms",
                           "memory_mib", "output_mib",    "density",         "median_percent",
                           "over_1px",   "over_2percent", "occluded_filled", "truth_pixels"};
  std::string csv;
  for (const char* column : columns) csv += (csv.empty() ? "" : ",") + std::string(column);
  csv += "\n";
  for (const Json& row : rows) {
    bool first = true;
    for (const char* column : columns) {
      csv += (first ? "" : ",") + row.at(column).dump();
      first = false;
    }
    csv += "\n";
  }
  return csv;
}

int run(int argc, char** argv) {
  Settings settings;
  CLI::App app("Times, memory and errors of the stereo matchers on rendered pairs");
  app.add_option("--suite", settings.suite, "compare, accuracy or scaling")
      ->check(CLI::IsMember({"compare", "accuracy", "scaling"}))
      ->capture_default_str();
  app.add_option("--scene", settings.scene, "A shipped scene's name or a scene file")
      ->capture_default_str();
  app.add_option("--scenes", settings.scenes, "Folder of the shipped scenes")
      ->capture_default_str();
  app.add_option("--lens", settings.lens, "Lens file; default: 180 degrees, equidistant, any size");
  app.add_option("--size", settings.sizes, "Image sizes, WxH")->capture_default_str();
  app.add_option("--threads", settings.threads, "Numbers of threads; default: one and all");
  app.add_option("--methods", settings.methods,
                 "sweep, its costs zncc and eq3.1, its windows ray, fronto and best; thesis, bm, "
                 "sgbm, 3way")
      ->check(CLI::IsMember(
          {"sweep", "zncc", "eq3.1", "ray", "fronto", "best", "thesis", "bm", "sgbm", "3way"}))
      ->capture_default_str();
  app.add_option("--runs", settings.runs, "Timed runs, by turns")
      ->check(CLI::Range(1, 1000))
      ->capture_default_str();
  app.add_option("--thesis-rows", settings.thesis_row,
                 "Also the thesis' matcher on every N-th row, its time scaled to the frame")
      ->check(CLI::Range(0, 10000));
  app.add_option("--noise", settings.noise, "Image noise, sigma [grey levels]")
      ->check(CLI::Range(0.0, 100.0))
      ->capture_default_str();
  app.add_option("--out", settings.out,
                 "Folder for SUITE.json and SUITE.csv (scaling: also a plot)");
  CLI11_PARSE(app, argc, argv);
  if (settings.threads.empty()) {
    settings.threads.push_back(1);
    if (threadCount(0) > 1) settings.threads.push_back(threadCount(0));
  }
  if (!settings.out.empty()) std::filesystem::create_directories(settings.out);
  const char* simd = std::getenv("OMNISTER_SIMD");
  Json json{
      {"suite", settings.suite},
      {"opencv", CV_VERSION},
      {"simd", simd == nullptr ? "" : simd},
      {"runs", settings.runs},
      {"noise_sigma", settings.noise},
      {"lens", settings.lens.empty() ? "equidistant, 180 degrees over the width" : settings.lens},
      {"cores", threadCount(0)}};
  if (settings.suite == "compare") {
    compare(settings, json);
  } else if (settings.suite == "accuracy") {
    accuracy(settings, json);
  } else {
    scaling(settings, json);
  }
  if (!settings.out.empty()) {
    const std::filesystem::path folder(settings.out);
    writeFileAtomically(folder / (settings.suite + ".json"), json.dump(1) + "\n");
    if (json.contains("rows"))
      writeFileAtomically(folder / (settings.suite + ".csv"), toCsv(json["rows"]));
  }
  return 0;
}

}  // namespace
}  // namespace omnister::bench

int main(int argc, char** argv) {
  cv::utils::logging::setLogLevel(cv::utils::logging::LOG_LEVEL_SILENT);
  return omnister::bench::report("omnister_bench_stereo",
                                 [&] { return omnister::bench::run(argc, argv); });
}
