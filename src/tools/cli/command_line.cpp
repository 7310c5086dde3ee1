// SPDX-License-Identifier: Apache-2.0
#include "tools/cli/command_line.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <deque>
#include <filesystem>
#include <iostream>
#include <memory>
#include <opencv2/core/utils/logger.hpp>

#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/common/numbers.h"
#include "tools/cli/commands.h"

namespace omnister::tools {

// One line a subcommand, in the order of --help.
void addCalibrate(CLI::App& app);
void addCalibrateScan(CLI::App& app);
void addCalibrateStereo(CLI::App& app);
void addImport(CLI::App& app);
void addExport(CLI::App& app);
void addProject(CLI::App& app);
void addUnproject(CLI::App& app);
void addStereo(CLI::App& app);
void addEvaluate(CLI::App& app);
void addRender(CLI::App& app);
void addDewarp(CLI::App& app);
void addTarget(CLI::App& app);
void addStore(CLI::App& app);
#ifdef OMNISTER_WITH_ROS
void addBag(CLI::App& app);
#endif
void addDoctor(CLI::App& app);

namespace {

constexpr AddCommand kCommands[] = {
    addCalibrate, addCalibrateScan, addCalibrateStereo, addImport,   addExport,
    addProject,   addUnproject,     addStereo,          addEvaluate, addRender,
    addDewarp,    addTarget,        addStore,
#ifdef OMNISTER_WITH_ROS
    addBag,
#endif
    addDoctor,
};

std::string describe(const nlohmann::ordered_json& value) {
  return value.is_string() ? value.get<std::string>() : jsonText(value);
}

}  // namespace

std::string jsonText(const nlohmann::ordered_json& value, int indent) {
  return value.dump(indent, ' ', false, nlohmann::ordered_json::error_handler_t::replace);
}

bool& addJsonFlag(CLI::App& command) {
  static std::deque<bool> flags;
  bool& flag = flags.emplace_back(false);
  command.add_flag("--json", flag,
                   "Print one JSON object on standard output and nothing else there");
  return flag;
}

namespace {

/// Where messages and progress go: standard error as it was at the beginning, also while image
/// libraries must not write there.
class Console {
 public:
  void open() {
    close();
    descriptor_ = ::fcntl(STDERR_FILENO, F_DUPFD_CLOEXEC, STDERR_FILENO + 1);
  }
  void close() {
    if (descriptor_ >= 0) ::close(descriptor_);
    descriptor_ = -1;
  }
  void write(const std::string& text) const {
    ::dprintf(descriptor_ < 0 ? STDERR_FILENO : descriptor_, "%s", text.c_str());
  }

 private:
  int descriptor_ = -1;
};

Console console;

/// Whether a terminal's last line shows progress that other text must not run into.
bool progress_line_open = false;

void closeProgressLine() {
  if (progress_line_open) console.write("\r\033[K");
  progress_line_open = false;
}

}  // namespace

void printResult(bool json, const nlohmann::ordered_json& result) {
  closeProgressLine();
  if (json) {
    std::cout << jsonText(result) << '\n';
  } else {
    for (const auto& [key, value] : result.items()) {
      std::cout << key << ": " << describe(value) << '\n';
    }
  }
  std::cout.flush();
  if (!std::cout) throw Error("cannot write to standard output");
}

void say(const std::string& message) {
  closeProgressLine();
  console.write(message + '\n');
}

Progress consoleProgress() {
  using Clock = std::chrono::steady_clock;
  struct State {
    Clock::time_point start = Clock::now();
    Clock::time_point last = start;
    std::string stage;
    double fraction = 0.0;
  };
  const bool terminal = ::isatty(STDERR_FILENO) == 1;
  return [state = std::make_shared<State>(), terminal](double fraction, const std::string& stage) {
    const auto now = Clock::now();
    // Stages that each begin at nothing are timed by themselves; those that share one whole,
    // together.
    if (stage != state->stage && fraction <= state->fraction) state->start = now;
    state->stage = stage;
    state->fraction = fraction;
    // What is over at once needs no line, least of all before an error.
    if (now - state->last < std::chrono::milliseconds(terminal ? 200 : 2000)) return;
    state->last = now;
    const double elapsed = std::chrono::duration<double>(now - state->start).count();
    const double left = fraction > 0.0 ? elapsed * (1.0 - fraction) / fraction : 0.0;
    std::string line = stage + ": " + std::to_string(std::lround(100.0 * fraction)) + " %";
    if (fraction > 0.0) line += ", " + std::to_string(std::lround(left)) + " s left";
    console.write(terminal ? "\r\033[K" + line : line + '\n');
    progress_line_open = terminal;
  };
}

namespace {

bool sameFile(const std::filesystem::path& a, const std::filesystem::path& b) {
  std::error_code ignored;
  if (std::filesystem::equivalent(a, b, ignored)) return true;
  return std::filesystem::weakly_canonical(a, ignored) ==
         std::filesystem::weakly_canonical(b, ignored);
}

}  // namespace

void checkOutputs(const std::vector<std::string>& inputs, const std::vector<std::string>& outputs) {
  std::vector<std::string> others = inputs;
  for (const std::string& output : outputs) {
    if (output.empty()) continue;
    for (std::size_t i = 0; i < others.size(); ++i) {
      if (others[i].empty() || !sameFile(output, others[i])) continue;
      throw InputError(output, "",
                       i < inputs.size() ? "is an input and an output at once"
                                         : "stands for two outputs, expected a file for each");
    }
    const std::filesystem::path folder = std::filesystem::path(output).parent_path();
    std::error_code ignored;
    if (!folder.empty() && !std::filesystem::is_directory(folder, ignored)) {
      throw InputError(output, "",
                       "cannot be written: there is no folder " + printable(folder.string()));
    }
    if (std::filesystem::is_directory(output, ignored)) {
      throw InputError(output, "", "cannot be written: it is a folder");
    }
    if (::access(folder.empty() ? "." : folder.c_str(), W_OK | X_OK) != 0) {
      throw InputError(output, "", "cannot be written: its folder may not be written to");
    }
    others.push_back(output);
  }
}

bool lexical_cast(const std::string& text, Size& size) {
  const std::size_t cross = text.find('x');
  if (cross == std::string::npos) return false;
  const auto width = parseNumber(text.substr(0, cross));
  const auto height = parseNumber(text.substr(cross + 1));
  if (!width || !height) return false;
  const auto whole = [](double value) {
    return value >= 1 && value <= 65535 && value == int(value);
  };
  if (!whole(*width) || !whole(*height)) return false;
  size = {static_cast<int>(*width), static_cast<int>(*height)};
  return true;
}

int runCommandLine(int argc, const char* const* argv) {
  // Our messages say what is wrong with a file; a library's chatter would come before them.
  cv::utils::logging::setLogLevel(cv::utils::logging::LOG_LEVEL_SILENT);
  silenceDecoders();
  console.open();
  CLI::App app("OMNister: wide-angle stereo from distorted images", "omnister");
  app.set_version_flag("--version", OMNISTER_VERSION);
  app.require_subcommand(1);
  for (const AddCommand add : kCommands) {
    add(app);
  }
  // --help is looked at before anything else, and would hide it.
  const auto named = [&](const CLI::App* command) { return command->check_name(argv[1]); };
  const std::vector<CLI::App*> commands = app.get_subcommands([](CLI::App*) { return true; });
  if (argc > 1 && argv[1][0] != '-' && std::none_of(commands.begin(), commands.end(), named)) {
    std::cerr << "omnister: there is no subcommand '" << printable(argv[1], 60)
              << "'; omnister --help lists them\n";
    return 2;
  }
  try {
    app.parse(argc, argv);
    closeProgressLine();
    return 0;
  } catch (const CLI::ParseError& error) {
    if (app.exit(error) != 0) return 2;
    if (std::cout.flush()) return 0;
    say("omnister: cannot write to standard output");
  } catch (const Error& error) {
    say(std::string("omnister: ") + error.what());
  } catch (const std::bad_alloc&) {
    say("omnister: not enough memory");
  } catch (const std::exception& error) {
    say("omnister: " + printable(error.what(), 1000));
  }
  return 1;
}

}  // namespace omnister::tools
