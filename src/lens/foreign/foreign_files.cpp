// SPDX-License-Identifier: Apache-2.0
// Reading the files of other calibrators. Nothing here trusts its input: ROS' own parser aborts on
// wrong sizes and OpenCV's crashes on deep nesting, so neither is called.
#include <algorithm>
#include <cctype>
#include <cmath>
#include <map>

#include "lens/file/yaml_view.h"
#include "lens/foreign/foreign_models.h"
#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/lens/lens_import.h"

namespace omnister {
namespace {

using namespace detail;

constexpr double kMaxPixel = 1e7;

Eigen::Matrix3d cameraMatrix(double fx, double fy, double cx, double cy) {
  Eigen::Matrix3d K;
  K << fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0;
  return K;
}

std::string joined(const std::vector<std::string>& words) {
  std::string out;
  for (const std::string& word : words) out += (out.empty() ? "" : ", ") + word;
  return out;
}

void checkCore(double fx, double fy, double cx, double cy,
               const std::function<void(const std::string&)>& refuse) {
  if (!(fx > 0.0) || !(fy > 0.0) || fx > kMaxPixel || fy > kMaxPixel) {
    refuse("has the focal lengths " + formatNumber(fx) + " and " + formatNumber(fy) +
           ", expected positive pixels");
  }
  if (!(std::abs(cx) <= kMaxPixel) || !(std::abs(cy) <= kMaxPixel)) {
    refuse("has the centre (" + formatNumber(cx) + ", " + formatNumber(cy) + "), expected pixels");
  }
}

// ---------------------------------------------------------------- ROS camera_info

ForeignCamera readCameraInfo(std::string_view text, std::string_view source) {
  const YamlView root = YamlView::load(text, source);
  ForeignCamera out;
  out.format = "camera_info";
  out.image_size.width = root.at("image_width").whole(1, 65535);
  out.image_size.height = root.at("image_height").whole(1, 65535);
  if (const auto name = root.find("camera_name")) out.camera_name = name->text();
  const auto matrix = [&](const std::string& key, int rows, int cols) {
    const YamlView block = root.at(key);
    block.at("rows").whole(rows, rows);
    block.at("cols").whole(cols, cols);
    return block.at("data").numbers(static_cast<std::size_t>(rows) * cols);
  };
  const Numbers k = matrix("camera_matrix", 3, 3);
  const YamlView K_view = root.at("camera_matrix").at("data");
  if (std::all_of(k.begin(), k.end(), [](double v) { return v == 0.0; })) {
    K_view.refuse("is all zeros: this camera is not calibrated");
  }
  checkCore(k[0], k[4], k[2], k[5], [&](const std::string& problem) { K_view.refuse(problem); });
  if (k[3] != 0.0 || k[6] != 0.0 || k[7] != 0.0 || k[8] != 1.0) {
    K_view.refuse("is no camera matrix, expected [fx, s, cx, 0, fy, cy, 0, 0, 1]");
  }
  Eigen::Matrix3d K = cameraMatrix(k[0], k[4], k[2], k[5]);
  K(0, 1) = k[1];
  const YamlView model = root.at("distortion_model");
  out.model = model.text();
  const YamlView D_block = root.at("distortion_coefficients");
  const YamlView D_view = D_block.at("data");
  const Numbers d = D_view.numbers();
  D_block.at("rows").whole(1, 1);
  D_block.at("cols").whole(static_cast<int>(d.size()), static_cast<int>(d.size()));
  const auto count = [&](std::initializer_list<std::size_t> allowed, const char* expected) {
    if (std::find(allowed.begin(), allowed.end(), d.size()) == allowed.end()) {
      D_view.refuse("has " + std::to_string(d.size()) + " numbers, expected " + expected + " for " +
                    out.model);
    }
  };
  if (out.model == "plumb_bob") {
    count({0, 4, 5}, "5 (k1 k2 p1 p2 k3)");
    out.project = pinholeProject(K, openCvBend(d));
  } else if (out.model == "rational_polynomial") {
    count({8, 12, 14}, "8 (k1 k2 p1 p2 k3 k4 k5 k6)");
    if (d.size() == 14 && (d[12] != 0.0 || d[13] != 0.0)) {
      D_view.refuse("has a tilted sensor (numbers 13 and 14), which is not supported");
    }
    out.project = pinholeProject(K, openCvBend(d));
  } else if (out.model == "equidistant" || out.model == "fisheye") {
    count({4}, "4 (k1 k2 k3 k4)");
    out.model = "equidistant";
    out.project = equidistantProject(K, d);
    out.wide = true;
  } else {
    model.refuse("is \"" + printable(out.model) +
                 "\", expected plumb_bob, rational_polynomial or equidistant");
  }
  out.center = {k[2], k[5]};
  return out;
}

// ---------------------------------------------------------------- Kalibr

ForeignCamera readKalibrCamera(const YamlView& block) {
  ForeignCamera out;
  out.format = "kalibr";
  const YamlView model = block.at("camera_model");
  const std::string name = model.text();
  const YamlView size = block.at("resolution");
  const std::vector<YamlView> sides = size.items();
  if (sides.size() != 2)
    size.refuse("has " + std::to_string(sides.size()) + " entries, expected 2");
  out.image_size = {sides[0].whole(1, 65535), sides[1].whole(1, 65535)};

  struct Form {
    const char* name;
    std::size_t extra;  // numbers before fu fv pu pv
    const char* expected;
  };
  static constexpr Form kForms[] = {{"pinhole", 0, "4 (fu fv pu pv)"},
                                    {"omni", 1, "5 (xi fu fv pu pv)"},
                                    {"ds", 2, "6 (xi alpha fu fv pu pv)"},
                                    {"eucm", 2, "6 (alpha beta fu fv pu pv)"}};
  const Form* form = nullptr;
  for (const Form& candidate : kForms) {
    if (name == candidate.name) form = &candidate;
  }
  if (form == nullptr) {
    model.refuse("is \"" + printable(name) + "\", expected pinhole, omni, ds or eucm");
  }
  const YamlView intrinsics = block.at("intrinsics");
  const Numbers k = intrinsics.numbers();
  if (k.size() != form->extra + 4) {
    intrinsics.refuse("has " + std::to_string(k.size()) + " numbers, expected " + form->expected +
                      " for " + name);
  }
  const double* core = k.data() + form->extra;
  checkCore(core[0], core[1], core[2], core[3],
            [&](const std::string& problem) { intrinsics.refuse(problem); });
  const Eigen::Matrix3d K = cameraMatrix(core[0], core[1], core[2], core[3]);
  out.center = {core[2], core[3]};

  std::string distortion = "none";
  Numbers d;
  const auto kind = block.find("distortion_model");
  if (kind) distortion = kind->text();
  if (const auto coefficients = block.find("distortion_coeffs")) d = coefficients->numbers();
  const auto need = [&](std::size_t count, const char* expected) {
    if (d.size() != count) {
      block.at("distortion_coeffs")
          .refuse("has " + std::to_string(d.size()) + " numbers, expected " + expected + " for " +
                  distortion);
    }
  };
  const bool plane = name == "pinhole" || name == "omni";
  PlaneBend bend = openCvBend({});
  if (distortion == "radtan") {
    need(4, "4 (k1 k2 p1 p2)");
    bend = openCvBend(d);
  } else if (distortion == "fov") {
    need(1, "1 (w)");
    if (!(d[0] > 1e-6) || !(d[0] < 3.14)) {
      block.at("distortion_coeffs").refuse("is " + formatNumber(d[0]) + ", expected radians");
    }
    bend = fovBend(d[0]);
  } else if (distortion == "equidistant" && name == "pinhole") {
    need(4, "4 (k1 k2 k3 k4)");
  } else if (distortion != "none") {
    kind->refuse("is \"" + printable(distortion) +
                 "\", expected radtan, equidistant (of a pinhole), "
                 "fov or none");
  }
  if (!plane && distortion != "none" &&
      std::any_of(d.begin(), d.end(), [](double v) { return v != 0.0; })) {
    kind->refuse("is \"" + printable(distortion) + "\", expected none for " + name);
  }
  out.model = name + "-" + distortion;
  out.wide = name != "pinhole" || distortion == "equidistant";
  if (name == "pinhole") {
    out.project = distortion == "equidistant" ? equidistantProject(K, d) : pinholeProject(K, bend);
  } else if (name == "omni") {
    if (!(k[0] > -1.0) || !(k[0] < 1e3)) {
      intrinsics.refuse("has xi = " + formatNumber(k[0]) + ", expected more than -1");
    }
    out.project = omniProject(K, k[0], bend);
  } else if (name == "ds") {
    if (!(k[0] > -1.0 && k[0] < 10.0) || !(k[1] >= 0.0 && k[1] <= 1.0)) {
      intrinsics.refuse("has xi = " + formatNumber(k[0]) + " and alpha = " + formatNumber(k[1]) +
                        ", expected xi above -1 and alpha from 0 to 1");
    }
    out.project = doubleSphereProject(K, k[0], k[1]);
  } else {
    if (!(k[0] >= 0.0 && k[0] <= 1.0) || !(k[1] > 0.0 && k[1] < 1e6)) {
      intrinsics.refuse("has alpha = " + formatNumber(k[0]) + " and beta = " + formatNumber(k[1]) +
                        ", expected alpha from 0 to 1 and a positive beta");
    }
    out.project = eucmProject(K, k[0], k[1]);
  }
  return out;
}

ForeignCamera readKalibr(std::string_view text, std::string_view source,
                         const std::string& camera) {
  const YamlView root = YamlView::load(text, source);
  std::vector<std::string> cameras;
  for (const std::string& key : root.keys()) {
    const auto block = root.find(key);
    if (block && block->isMap() && block->find("camera_model")) cameras.push_back(key);
  }
  if (cameras.empty()) {
    throw InputError(source, "", "has no camera (a key such as cam0 with a camera_model)");
  }
  std::string chosen = camera.empty() ? cameras.front() : camera;
  if (std::find(cameras.begin(), cameras.end(), chosen) == cameras.end()) {
    throw InputError(source, chosen,
                     "is no camera of this file, expected one of " + joined(cameras));
  }
  ForeignCamera out = readKalibrCamera(root.at(chosen));
  out.camera_name = chosen;
  if (camera.empty() && cameras.size() > 1) {
    out.remarks.push_back(std::string(source) + " has the cameras " + joined(cameras) + "; took " +
                          chosen + " (choose with --camera)");
  }
  return out;
}

// ---------------------------------------------------------------- OCamCalib

ForeignCamera readOcam(std::string_view text, std::string_view source) {
  // Numbers with the line they stand on; comments run from # to the end of a line.
  struct Token {
    double value;
    int line;
  };
  std::vector<Token> tokens;
  int line_number = 0;
  for (std::size_t begin = 0; begin < text.size();) {
    ++line_number;
    const std::size_t end = std::min(text.find('\n', begin), text.size());
    std::string_view line = text.substr(begin, end - begin);
    begin = end + 1;
    line = line.substr(0, line.find_first_of("#%"));
    const auto numbers = parseNumbers(line);
    if (!numbers) {
      throw InputError(source, "line " + std::to_string(line_number),
                       "is \"" + printable(line, 60) + "\", expected numbers");
    }
    for (const double value : *numbers) {
      if (!std::isfinite(value)) {
        throw InputError(source, "line " + std::to_string(line_number),
                         "has " + formatNumber(value) + ", expected finite numbers");
      }
      tokens.push_back({value, line_number});
    }
    if (tokens.size() > 1000) throw InputError(source, "", "has too many numbers for OCamCalib");
  }
  std::size_t next = 0;
  const auto take = [&](std::size_t count, const char* what) {
    if (tokens.size() - next < count) {
      throw InputError(
          source, "line " + std::to_string(line_number),
          std::string("ends within ") + what + ", expected " + std::to_string(count) + " numbers");
    }
    Numbers out;
    for (std::size_t i = 0; i < count; ++i) out.push_back(tokens[next++].value);
    return out;
  };
  const auto place = [&] { return "line " + std::to_string(tokens[next > 0 ? next - 1 : 0].line); };
  const auto polynomial = [&](const char* what) {
    const double count = take(1, what)[0];
    if (count != std::floor(count) || count < 1 || count > 100) {
      throw InputError(source, place(),
                       std::string("counts ") + formatNumber(count) + " coefficients of " + what +
                           ", expected a whole number from 1 to 100");
    }
    return take(static_cast<std::size_t>(count), what);
  };
  OcamNumbers ocam;
  ocam.polynomial = polynomial("the direct polynomial");
  const std::string polynomial_place = place();
  polynomial("the inverse polynomial");  // a fit to the direct one: not needed
  const Numbers center = take(2, "the centre (row, column)");
  const Numbers affine = take(3, "the affine numbers c, d, e");
  const std::string affine_place = place();
  const Numbers size = take(2, "the image size (height, width)");
  ForeignCamera out;
  out.format = "ocam";
  out.model = "ocam";
  for (const double side : size) {
    if (side != std::floor(side) || side < 1 || side > 65535) {
      throw InputError(source, place(),
                       "has an image size of " + formatNumber(side) +
                           ", expected whole numbers from 1 to 65535");
    }
  }
  if (next != tokens.size()) {
    throw InputError(source, "line " + std::to_string(tokens[next].line),
                     "has numbers after the image size");
  }
  out.image_size = {static_cast<int>(size[1]), static_cast<int>(size[0])};
  if (!(ocam.polynomial[0] < 0.0)) {
    throw InputError(source, polynomial_place,
                     "has " + formatNumber(ocam.polynomial[0]) +
                         " as the polynomial's first number, expected a negative one");
  }
  ocam.center_row = center[0];
  ocam.center_col = center[1];
  ocam.c = affine[0];
  ocam.d = affine[1];
  ocam.e = affine[2];
  if (!(ocam.c - ocam.d * ocam.e > 0.1) || !(std::abs(center[0]) < kMaxPixel) ||
      !(std::abs(center[1]) < kMaxPixel)) {
    throw InputError(source, affine_place, "has affine numbers that mirror or flatten the image");
  }
  out.center = {center[1], center[0]};
  out.project = ocamProject(ocam, 2.0 * std::hypot(size[0], size[1]));
  out.wide = true;
  return out;
}

// ---------------------------------------------------------------- mrcal

// The literal of a Python dictionary of strings, numbers and lists, which is what mrcal writes.
class PythonDict {
 public:
  struct Value {
    enum Kind { kNothing, kText, kNumbers } kind = kNothing;
    std::string text;
    Numbers numbers;  // a list, flattened
    int line = 0;
  };

  PythonDict(std::string_view text, std::string_view source) : text_(text), source_(source) {
    expect('{');
    while (!accept('}')) {
      const std::string key = string();
      if (values_.count(key) != 0) refuse("has the key \"" + printable(key) + "\" twice");
      expect(':');
      values_[key] = value();
      if (!accept(',')) {
        expect('}');
        break;
      }
    }
  }

  const Value* find(const std::string& key) const {
    const auto found = values_.find(key);
    return found == values_.end() || found->second.kind == Value::kNothing ? nullptr
                                                                           : &found->second;
  }

 private:
  [[noreturn]] void refuse(const std::string& problem) const {
    throw InputError(source_, "line " + std::to_string(line_), problem);
  }
  char peek() {
    while (place_ < text_.size()) {
      const char c = text_[place_];
      if (c == '#') {
        place_ = std::min(text_.find('\n', place_), text_.size());
      } else if (c == '\n') {
        ++line_;
        ++place_;
      } else if (c == ' ' || c == '\t' || c == '\r') {
        ++place_;
      } else {
        return c;
      }
    }
    return '\0';
  }
  bool accept(char c) {
    if (peek() != c) return false;
    ++place_;
    return true;
  }
  void expect(char c) {
    if (!accept(c)) {
      const std::string here = printable(text_.substr(std::min(place_, text_.size()), 20));
      refuse("is \"" + here + "\", expected '" + c + "'");
    }
  }
  std::string string() {
    const char quote = peek();
    if (quote != '\'' && quote != '"') {
      const std::string here = printable(text_.substr(std::min(place_, text_.size()), 20));
      refuse("is \"" + here + "\", expected quoted text");
    }
    ++place_;
    std::string out;
    for (; place_ < text_.size() && text_[place_] != quote; ++place_) {
      if (text_[place_] == '\\') ++place_;
      if (place_ < text_.size()) {
        if (text_[place_] == '\n') ++line_;
        out += text_[place_];
      }
    }
    if (place_ >= text_.size()) refuse("ends within quoted text");
    ++place_;
    return out;
  }
  std::string_view word() {
    const std::size_t begin = place_;
    while (place_ < text_.size() &&
           std::string_view(" \t\r\n,]})([{#:'\"").find(text_[place_]) == std::string_view::npos) {
      ++place_;
    }
    return text_.substr(begin, place_ - begin);
  }
  Value value() {
    Value out;
    const char first = peek();
    out.line = line_;
    if (first == '\'' || first == '"') {
      out.kind = Value::kText;
      out.text = string();
    } else if (first == '[' || first == '(') {
      out.kind = Value::kNumbers;
      list(out.numbers, 0);
    } else {
      const std::string_view name = word();
      if ((name == "b" || name == "r") && (peek() == '\'' || peek() == '"')) {
        string();  // packed optimization inputs: not ours
      } else if (const auto number = parseNumber(name)) {
        out.kind = Value::kNumbers;
        out.numbers.push_back(*number);
      } else if (name != "None" && name != "True" && name != "False") {
        refuse("is \"" + printable(name, 40) + "\", expected a value");
      }
    }
    return out;
  }
  void list(Numbers& out, int depth) {
    if (depth > 8) refuse("has lists nested too deeply");
    const char close = peek() == '[' ? ']' : ')';
    ++place_;
    while (!accept(close)) {
      const char c = peek();
      if (c == '[' || c == '(') {
        list(out, depth + 1);
      } else {
        const std::string_view name = word();
        const auto number = parseNumber(name);
        if (!number || !std::isfinite(*number)) {
          refuse("is \"" + printable(name, 40) + "\", expected a finite number");
        }
        out.push_back(*number);
        if (out.size() > 1000000) refuse("has a list of more than a million numbers");
      }
      if (!accept(',')) {
        expect(close);
        break;
      }
    }
  }

  std::string_view text_;
  std::string source_;
  std::size_t place_ = 0;
  int line_ = 1;
  std::map<std::string, Value> values_;
};

// "..._Nx=30_Ny=20" -> the whole number behind "_Nx=".
int configured(const std::string& model, const std::string& key, int least, int most,
               const std::function<void(const std::string&)>& refuse) {
  const std::size_t begin = model.find("_" + key + "=");
  std::optional<double> value;
  if (begin != std::string::npos) {
    const std::size_t from = begin + key.size() + 2;
    value = parseNumber(std::string_view(model).substr(from, model.find('_', from) - from));
  }
  if (!value || *value != std::floor(*value) || *value < least || *value > most) {
    refuse("is \"" + printable(model) + "\", expected " + key + "= a whole number from " +
           std::to_string(least) + " to " + std::to_string(most));
  }
  return static_cast<int>(*value);
}

ForeignCamera readMrcal(std::string_view text, std::string_view source) {
  const PythonDict dict(text, source);
  ForeignCamera out;
  out.format = "mrcal";
  const auto need = [&](const char* key, PythonDict::Value::Kind kind, const char* expected) {
    const PythonDict::Value* value = dict.find(key);
    if (value == nullptr) throw InputError(source, key, "is missing");
    if (value->kind != kind) {
      throw InputError(source, key, std::string("is something else, expected ") + expected);
    }
    return value;
  };
  const char* model_key = dict.find("lensmodel") == nullptr && dict.find("lens_model") != nullptr
                              ? "lens_model"
                              : "lensmodel";
  const auto* model = need(model_key, PythonDict::Value::kText, "the name of a lens model");
  const auto* intrinsics = need("intrinsics", PythonDict::Value::kNumbers, "a list of numbers");
  const auto* size = need("imagersize", PythonDict::Value::kNumbers, "[width, height]");
  const auto refuseAt = [&](const char* key, const PythonDict::Value* value) {
    return [&source, key, line = value->line](const std::string& problem) {
      throw InputError(source, std::string(key) + " (line " + std::to_string(line) + ")", problem);
    };
  };
  const auto refuse_model = refuseAt(model_key, model);
  const auto refuse_intrinsics = refuseAt("intrinsics", intrinsics);
  if (size->numbers.size() != 2) refuseAt("imagersize", size)("expected [width, height]");
  for (const double side : size->numbers) {
    if (side != std::floor(side) || side < 1 || side > 65535) {
      refuseAt("imagersize",
               size)("is " + formatNumber(side) + ", expected whole numbers from 1 to 65535");
    }
  }
  out.image_size = {static_cast<int>(size->numbers[0]), static_cast<int>(size->numbers[1])};
  out.model = model->text;

  const std::map<std::string, std::size_t> counts{
      {"LENSMODEL_PINHOLE", 4},  {"LENSMODEL_OPENCV4", 8},   {"LENSMODEL_OPENCV5", 9},
      {"LENSMODEL_OPENCV8", 12}, {"LENSMODEL_OPENCV12", 16}, {"LENSMODEL_CAHVOR", 9}};
  const Numbers& k = intrinsics->numbers;
  SplinedStereographic spline;
  std::size_t count = 0;
  const bool splined = out.model.rfind("LENSMODEL_SPLINED_STEREOGRAPHIC_", 0) == 0;
  if (splined) {
    spline.order = configured(out.model, "order", 2, 3, refuse_model);
    spline.nx = configured(out.model, "Nx", 4, 500, refuse_model);
    spline.ny = configured(out.model, "Ny", 4, 500, refuse_model);
    spline.fov_x = configured(out.model, "fov_x_deg", 1, 359, refuse_model) * (M_PI / 180.0);
    count = 4 + 2 * static_cast<std::size_t>(spline.nx) * spline.ny;
  } else if (counts.count(out.model) != 0) {
    count = counts.at(out.model);
  } else {
    std::vector<std::string> names;
    for (const auto& entry : counts) names.push_back(entry.first);
    refuse_model("is \"" + printable(out.model) + "\", expected one of " + joined(names) +
                 ", LENSMODEL_SPLINED_STEREOGRAPHIC_…");
  }
  if (k.size() != count) {
    refuse_intrinsics("has " + std::to_string(k.size()) + " numbers, expected " +
                      std::to_string(count) + " for " + printable(out.model));
  }
  checkCore(k[0], k[1], k[2], k[3], refuse_intrinsics);
  const Eigen::Matrix3d K = cameraMatrix(k[0], k[1], k[2], k[3]);
  const Numbers rest(k.begin() + 4, k.end());
  if (splined) {
    spline.control_points = rest;
    out.project = splinedStereographicProject(K, spline);
  } else if (out.model == "LENSMODEL_CAHVOR") {
    out.project = cahvorProject(K, rest);
  } else {
    out.project = pinholeProject(K, openCvBend(rest));
  }
  out.center = {k[2], k[3]};
  return out;
}

std::string guessFormat(std::string_view text, std::string_view source) {
  const std::size_t first = text.find_first_not_of(" \t\r\n");
  if (first == std::string_view::npos) throw InputError(source, "", "is empty");
  if (text.find("'lensmodel'") != std::string_view::npos ||
      text.find("\"lensmodel\"") != std::string_view::npos ||
      text.find("'lens_model'") != std::string_view::npos) {
    return "mrcal";
  }
  if (text.find("camera_model") != std::string_view::npos &&
      text.find("intrinsics") != std::string_view::npos) {
    return "kalibr";
  }
  if (text.find("camera_matrix") != std::string_view::npos ||
      text.find("image_width") != std::string_view::npos) {
    return "camera_info";
  }
  // OCamCalib is nothing but numbers and comments.
  bool numbers = true;
  for (std::size_t begin = 0; begin < text.size() && numbers;) {
    const std::size_t end = std::min(text.find('\n', begin), text.size());
    std::string_view line = text.substr(begin, end - begin);
    begin = end + 1;
    numbers = parseNumbers(line.substr(0, line.find_first_of("#%"))).has_value();
  }
  if (numbers) return "ocam";
  throw InputError(source, "",
                   "is none of the known calibrations (ROS camera_info, Kalibr camchain, OCamCalib "
                   "text, mrcal .cameramodel); name it with --format");
}

}  // namespace

const std::vector<std::string>& foreignFormats() {
  static const std::vector<std::string> formats{"auto", "camera_info", "kalibr", "ocam", "mrcal"};
  return formats;
}

ForeignCamera readForeignCamera(std::string_view text, std::string_view source,
                                const std::string& format, const std::string& camera) {
  const std::string chosen = format == "auto" ? guessFormat(text, source) : format;
  if (!camera.empty() && chosen != "kalibr") {
    throw InputError(source, "",
                     "holds one camera, so --camera " + printable(camera) + " says nothing here");
  }
  if (chosen == "camera_info") return readCameraInfo(text, source);
  if (chosen == "kalibr") return readKalibr(text, source, camera);
  if (chosen == "ocam") return readOcam(text, source);
  if (chosen == "mrcal") return readMrcal(text, source);
  throw Error("unknown calibration format " + printable(format) + ", expected one of " +
              joined(foreignFormats()));
}

}  // namespace omnister
