// Run an exported graph (afm-rl-export out=policy.onnx) without Python and without torch.
//
//   c++ -O2 -std=c++17 run_onnx.cpp -o run_onnx -ldl
//   echo "CHECKSUM  policy.onnx" | sha256sum -c && ./run_onnx libonnxruntime.so policy.onnx [SEED] < states.txt
//
// The library is that of the Python package, onnxruntime/capi/libonnxruntime.so.*, or of any release
// since 1.16. Each line of the input is one tick: the state, then the task's numbers, such as the goal
// or the planned action. Each line of the output is the action to execute. What the file reads, and how
// long ticks took, goes to standard error.
#include <dlfcn.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <iostream>
#include <random>
#include <sstream>
#include <string>
#include <vector>

// What is used of onnxruntime's C interface: a table of functions that only ever grows at its end
// (onnxruntime_c_api.h, MIT), here by their place in it. They return null, or a status.
struct ApiBase {
  void* const* (*api)(uint32_t version);
  const char* (*version)();
};
enum Place {
  kGetErrorMessage = 2,
  kCreateEnv = 3,
  kCreateSession = 7,
  kRun = 9,
  kCreateSessionOptions = 10,
  kSetIntraOpNumThreads = 24,
  kCreateTensorWithData = 49,
  kGetTensorMutableData = 51,
  kCreateCpuMemoryInfo = 69,
  kGetAllocator = 78,
  kReleaseValue = 96,
  kGetModelMetadata = 111,
  kLookupMetadata = 116,
};
constexpr uint32_t kVersion = 16;
void* const* api;

template <class... T>
void call(Place place, T... given) {
  if (void* status = reinterpret_cast<void* (*)(T...)>(api[place])(given...)) {
    std::cerr << reinterpret_cast<const char* (*)(void*)>(api[kGetErrorMessage])(status) << "\n";
    std::exit(2);
  }
}

std::string look_up(void* about, void* allocator, const char* key) {
  char* text = nullptr;
  call(kLookupMetadata, about, allocator, key, &text);
  return text ? text : "";
}

// Answer each line with an action; numbers are of onnxruntime's type `kind`.
template <class Number>
void drive(void* session, int kind, std::istringstream arguments, double bound, size_t actions, uint64_t seed) {
  std::vector<std::string> names;            // the memory's, the observation, the task's, the noise
  std::vector<std::vector<int64_t>> shapes;
  std::vector<std::vector<Number>> given;
  for (std::string word; arguments >> word;) {  // such as memory.commands:2x80
    const auto colon = word.rfind(':');
    names.push_back(word.substr(0, colon));
    std::istringstream lengths(word.substr(colon + 1));
    shapes.emplace_back();
    size_t count = 1;
    for (std::string length; std::getline(lengths, length, 'x'); count *= shapes.back().back()) {
      shapes.back().push_back(std::stoll(length));
    }
    given.emplace_back(count, Number(0));
  }
  std::vector<std::string> results;  // the next memory's, and the action
  for (const auto& name : names) {
    if (name.rfind("memory.", 0) == 0) results.push_back("next_" + name);
  }
  const size_t fields = results.size();
  results.push_back("executed_action");
  std::vector<const char*> inputs;
  std::vector<void*> tensors(given.size());
  void* cpu;
  call(kCreateCpuMemoryInfo, 0, 0, &cpu);
  for (size_t k = 0; k < given.size(); ++k) {
    inputs.push_back(names[k].c_str());
    call(kCreateTensorWithData, cpu, static_cast<void*>(given[k].data()), sizeof(Number) * given[k].size(),
         shapes[k].data(), shapes[k].size(), kind, &tensors[k]);
  }
  std::vector<const char*> outputs;
  for (const auto& name : results) outputs.push_back(name.c_str());
  std::mt19937_64 random(seed);
  std::normal_distribution<double> normal;
  std::vector<double> took;
  std::cout.precision(9);
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream numbers(line);
    for (size_t k = fields; k < given.size(); ++k) {
      for (Number& number : given[k]) {
        if (names[k] == "noise") {
          do number = normal(random);
          while (std::abs(number) > bound);
        } else if (!(numbers >> number)) {
          number = NAN;  // of a line that is too short: the policy ignores such a reading
        }
      }
    }
    std::vector<void*> found(outputs.size(), nullptr);
    const auto begun = std::chrono::steady_clock::now();
    call(kRun, session, static_cast<void*>(nullptr), inputs.data(), tensors.data(), tensors.size(),
         outputs.data(), outputs.size(), found.data());
    const std::chrono::duration<double, std::milli> spent = std::chrono::steady_clock::now() - begun;
    took.push_back(spent.count());
    Number* values = nullptr;
    for (size_t k = 0; k < fields; ++k) {
      call(kGetTensorMutableData, found[k], reinterpret_cast<void**>(&values));
      std::copy(values, values + given[k].size(), given[k].begin());
    }
    call(kGetTensorMutableData, found[fields], reinterpret_cast<void**>(&values));
    for (size_t i = 0; i < actions; ++i) std::cout << (i ? " " : "") << values[i];
    std::cout << std::endl;
    for (void* value : found) reinterpret_cast<void (*)(void*)>(api[kReleaseValue])(value);
  }
  if (took.empty()) return;
  std::nth_element(took.begin(), took.begin() + took.size() / 2, took.end());
  std::cerr << took.size() << " ticks, median " << took[took.size() / 2] << " ms\n";
}

int main(int argc, char** argv) {
  void* library = argc < 3 ? nullptr : dlopen(argv[1], RTLD_NOW);
  void* entry = library ? dlsym(library, "OrtGetApiBase") : nullptr;
  if (!entry) {
    std::cerr << "run_onnx LIBONNXRUNTIME.so POLICY.onnx [SEED] < STATES\n";
    return 2;
  }
  const auto* base = reinterpret_cast<const ApiBase* (*)()>(entry)();
  api = base->api(kVersion);
  void *env, *options, *session, *allocator, *about;
  call(kCreateEnv, 3, "run_onnx", &env);  // 3: errors alone
  call(kCreateSessionOptions, &options);
  call(kSetIntraOpNumThreads, options, 1);  // the work is many small steps
  call(kCreateSession, env, static_cast<const char*>(argv[2]), options, &session);
  call(kGetAllocator, &allocator);
  call(kGetModelMetadata, session, &about);
  const auto arguments = look_up(about, allocator, "arguments"), dtype = look_up(about, allocator, "dtype");
  if (arguments.empty()) {
    std::cerr << argv[2] << ": expected a graph of afm-rl-export\n";
    return 2;
  }
  std::cerr << "onnxruntime " << base->version() << ", arguments: " << arguments << "\n";
  const double bound = std::stod(look_up(about, allocator, "noise_bound"));
  const size_t actions = std::stoul(look_up(about, allocator, "actions"));
  const uint64_t seed = argc > 3 ? std::stoull(argv[3]) : 0;
  if (dtype == "float64") {
    drive<double>(session, 11, std::istringstream(arguments), bound, actions, seed);  // 11: double
  } else {
    drive<float>(session, 1, std::istringstream(arguments), bound, actions, seed);  // 1: float
  }
}
