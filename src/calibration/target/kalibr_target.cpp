// SPDX-License-Identifier: Apache-2.0
#include "calibration/target/kalibr_target.h"

#include <string>

#include "calibration/target/target_keys.h"

namespace omnister {
namespace {

// Kalibr reads YAML 1.1, where these are truth values too.
bool kalibrFlag(TargetKeys& keys, const std::string& key, std::string_view source) {
  const auto value = keys.text(key);
  if (!value) return false;
  for (const char* yes : {"true", "True", "TRUE", "yes", "Yes", "on", "On"}) {
    if (*value == yes) return true;
  }
  for (const char* no : {"false", "False", "FALSE", "no", "No", "off", "Off"}) {
    if (*value == no) return false;
  }
  throw InputError(source, key, "is " + inQuotes(*value) + ", expected True or False");
}

Target aprilGrid(TargetKeys& keys, std::string_view source) {
  Target target;
  target.type = TargetType::kAprilGrid;
  target.cols = keys.integer("tagCols");
  target.rows = keys.integer("tagRows");
  target.square_m = keys.number("tagSize");
  target.spacing = keys.number("tagSpacing");
  target.dictionary = "tag36h11";
  target.joining_squares = true;
  // Numbers that do not begin at 0 belong to boards that a TARGET.yaml cannot say.
  for (const char* first : {"codeOffset", "tagStartId", "tagStartID", "lowId"}) {
    if (keys.has(first) && keys.integer(first) != 0) {
      throw InputError(source, first,
                       "is " + inQuotes(*keys.text(first)) +
                           ", expected 0: only boards whose tags begin with number 0 are read");
    }
  }
  return target;
}

Target checkerboard(TargetKeys& keys, std::string_view source) {
  Target target;
  target.type = TargetType::kCheckerboard;
  target.cols = keys.integer("targetCols");
  target.rows = keys.integer("targetRows");
  target.square_m = keys.number("colSpacingMeters");
  const double rows_apart = keys.number("rowSpacingMeters");
  if (rows_apart != target.square_m) {
    throw InputError(source, "rowSpacingMeters",
                     "is " + formatNumber(rows_apart) + ", expected " +
                         formatNumber(target.square_m) +
                         " as colSpacingMeters: only boards of squares are read");
  }
  return target;
}

Target circleGrid(TargetKeys& keys, std::string_view source) {
  Target target;
  target.type = TargetType::kCircles;
  target.cols = keys.integer("targetCols");
  target.rows = keys.integer("targetRows");
  target.square_m = keys.number("spacingMeters");
  target.asymmetric = kalibrFlag(keys, "asymmetricGrid", source);
  return target;
}

}  // namespace

bool isKalibrTarget(const YAML::Node& root) {
  return root.IsMap() && !root["type"] && (root["target_type"] || root["tagCols"]);
}

Target parseKalibrTarget(const YAML::Node& root, std::string_view source) {
  TargetKeys keys(root, source);
  const std::string type = keys.text("target_type").value_or("aprilgrid");
  Target target;
  if (type == "aprilgrid") {
    target = aprilGrid(keys, source);
  } else if (type == "checkerboard") {
    target = checkerboard(keys, source);
  } else if (type == "circlegrid") {
    target = circleGrid(keys, source);
  } else {
    throw InputError(source, "target_type",
                     "is " + inQuotes(type) +
                         ", expected aprilgrid, checkerboard or circlegrid, as Kalibr has them");
  }
  keys.finish("Kalibr's " + type);
  return target;
}

}  // namespace omnister
