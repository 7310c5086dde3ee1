// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/stage_positions.h"

#include <cmath>
#include <map>
#include <set>

#include "calibration/data/csv_fields.h"
#include "omnister/common/error.h"
#include "omnister/common/file_io.h"
#include "omnister/common/numbers.h"

namespace omnister {

namespace {

using namespace calibration;

constexpr double kFarthest = 1e4;  // [m]

/// "3 views have no stage position and …: 'a', 'b' and 1 more"
std::string remark(const std::vector<std::string>& names, const char* singular,
                   const char* plural) {
  std::string text = names.size() == 1 ? std::string("one ") + singular
                                       : std::to_string(names.size()) + " " + plural;
  text += ": ";
  constexpr std::size_t kNamed = 5;
  for (std::size_t i = 0; i < names.size() && i < kNamed; ++i) {
    text += (i > 0 ? ", " : "") + inQuotes(names[i]);
  }
  if (names.size() > kNamed) text += " and " + std::to_string(names.size() - kNamed) + " more";
  return text;
}

}  // namespace

std::vector<StageView> parseStagePositions(std::string_view text, std::string_view source) {
  int line_number = 1;
  const auto refuse = [&](const char* column, const std::string& problem) {
    std::string place = "line " + std::to_string(line_number);
    if (column[0] != '\0') place += std::string(", column ") + column;
    throw InputError(source, place, problem);
  };
  const std::string header = takeHeader(text);
  const bool boards = header == "view,position_m,board";
  if (!boards && header != "view,position_m") {
    refuse("", "is " + inQuotes(header) +
                   ", expected the header view,position_m or view,position_m,board");
  }
  std::vector<StageView> positions;
  std::set<std::string> names;
  while (!text.empty()) {
    ++line_number;
    const std::string_view line = trimmed(takeLine(text));
    if (line.empty()) continue;
    const auto fields = fieldsOf(line);
    if (fields.size() != (boards ? 3u : 2u)) {
      refuse("", "has " + std::to_string(fields.size()) + " fields, expected " +
                     (boards ? "3: view,position_m,board" : "2: view,position_m"));
    }
    StageView row;
    row.view = fields[0];
    if (row.view.empty()) refuse("view", "is empty, expected the name of a view");
    const auto position = parseNumber(fields[1]);
    if (!position || !(std::abs(*position) <= kFarthest)) {
      refuse("position_m",
             "is " + inQuotes(fields[1]) + ", expected metres of at most 10000 either way");
    }
    row.stage.position_m = *position;
    if (boards) {
      row.stage.board = fields[2];
      if (row.stage.board.empty()) {
        refuse("board", "is empty, expected a name for the place of the board");
      }
    }
    if (!names.insert(row.view).second) {
      refuse("view", "is " + inQuotes(row.view) + ", which has a row already");
    }
    positions.push_back(std::move(row));
  }
  if (positions.empty()) throw InputError(source, "", "holds no position below its header");
  return positions;
}

std::vector<StageView> readStagePositions(const std::filesystem::path& path) {
  return parseStagePositions(readFile(path), path.string());
}

std::vector<std::string> applyStagePositions(const std::vector<StageView>& positions,
                                             std::string_view source, Detections& detections) {
  std::map<std::string, std::vector<std::size_t>> exact;
  std::map<std::string, std::vector<std::size_t>> by_file_name;
  for (std::size_t i = 0; i < detections.views.size(); ++i) {
    const std::string& name = detections.views[i].name;
    exact[name].push_back(i);
    by_file_name[std::filesystem::path(name).filename().string()].push_back(i);
  }
  std::vector<std::string> rows_without_view;
  std::size_t matched = 0;
  for (const StageView& row : positions) {
    auto found = exact.find(row.view);
    if (found == exact.end()) {
      found = by_file_name.find(row.view);
      if (found == by_file_name.end()) {
        rows_without_view.push_back(row.view);
        continue;
      }
    }
    if (found->second.size() > 1) {
      throw InputError(
          source, "view " + inQuotes(row.view),
          "could be any of " + std::to_string(found->second.size()) + " views, expected one");
    }
    auto& stage = detections.views[found->second.front()].stage;
    if (stage) {
      throw InputError(source, "view " + inQuotes(row.view),
                       "is named by two rows, expected one position for each view");
    }
    stage = row.stage;
    ++matched;
  }
  if (matched == 0) {
    throw InputError(source, "",
                     "names no view that has corners; the views are called like " +
                         (detections.views.empty() ? std::string("nothing")
                                                   : inQuotes(detections.views.front().name)));
  }
  std::vector<std::string> free;
  for (const ViewDetections& view : detections.views) {
    if (!view.stage) free.push_back(view.name);
  }
  std::vector<std::string> remarks;
  if (!rows_without_view.empty()) {
    remarks.push_back(remark(rows_without_view, "stage position belongs to no view with corners",
                             "stage positions belong to no view with corners"));
  }
  if (!free.empty()) {
    remarks.push_back(remark(free, "view has no stage position and gets a board pose of its own",
                             "views have no stage position and get board poses of their own"));
  }
  return remarks;
}

}  // namespace omnister
